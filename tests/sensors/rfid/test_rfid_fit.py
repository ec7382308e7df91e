"""Models of detection fitted to reads that a known model made."""

from dataclasses import replace

import numpy as np
import pytest
from changed_logs import with_rig

from factorgraph_loc import InputError, read_rig, write_rig
from factorgraph_loc.sensors.rfid.calibration import learn as rfid_learn
from factorgraph_loc.sensors.rfid.calibration.fields import Kind, choose, design_of, fit_grid
from factorgraph_loc.sensors.rfid.calibration.learn import learn_rfid
from factorgraph_loc.sensors.rfid.calibration.pairs import Floor, TagPairs, pairs_of, view_of
from factorgraph_loc.sensors.rfid.calibration.parametric import (
    FACING,
    beam,
    estimate_geometry,
    fit_model,
    logistic,
    pose_share,
)
from factorgraph_loc.sensors.rfid.calibration.rounds import rounds_of
from factorgraph_loc.sensors.rfid.calibration.signals import PhaseFit
from factorgraph_loc.sensors.rfid.settings import GridSettings, PhaseSettings, SurveySettings
from factors.rfid.model import BeamModel, GridModel, LogisticModel, logits, probability

TRUTH = LogisticModel((4.0, -1.6, 0.08, -1.7, 0.26, -0.06, -0.6, -0.1, 1.9, 0.23, -0.15))
FLOOR = Floor()


def drawn(model, count=40000, seed=0, height=0.5):
    """Pairs all around an antenna, each of four rounds, in two folds."""
    rng = np.random.default_rng(seed)
    r, bearing = 6.0 * np.sqrt(rng.random(count)), rng.uniform(-np.pi, np.pi, count)
    points = np.column_stack((r * np.cos(bearing), r * np.sin(bearing), rng.uniform(-height, height, count)))
    facing = rng.uniform(-1.0, 1.0, count)
    q = 0.02 + 0.96 * probability(model, points, facing)
    zeros = np.zeros(count, dtype=np.int64)
    return TagPairs(
        points,
        facing,
        rng.binomial(4, q).astype(float),
        np.full(count, 4.0),
        zeros,
        np.arange(count) % 500,
        np.arange(count) % 2,
        zeros,
    )


@pytest.fixture(scope="module")
def pairs():
    return drawn(TRUTH)


def fit_logistic(pairs, floor, with_facing):
    return fit_model(pairs, logistic(pairs, with_facing=with_facing), floor)[0]


def rms_error(model, truth, pairs):
    error = probability(model, pairs.points, pairs.facing) - probability(truth, pairs.points, pairs.facing)
    return float(np.sqrt(np.mean(error**2)))


def test_a_logistic_model_is_found(pairs):
    """160,000 rounds tell a probability to 0.003 on average with 11 parameters; 0.01 is beyond any chance."""
    assert rms_error(fit_logistic(pairs, FLOOR, with_facing=True), TRUTH, pairs) < 0.01


def test_without_facing_its_coefficients_are_zero(pairs):
    assert not any(fit_logistic(pairs, FLOOR, with_facing=False).coefficients[i] for i in FACING)


def test_a_beam_is_found():
    """From 80,000 rounds s_r, the least certain, is known to 2 %; 6 % are three standard errors."""
    truth = BeamModel(0.9, 3.5, 0.4, 0.7)
    found, _ = fit_model(drawn(truth, height=0.0), beam(BeamModel()), FLOOR)
    np.testing.assert_allclose((found.p0, found.r_max, found.s_r, found.sigma_phi), (0.9, 3.5, 0.4, 0.7), rtol=0.06)


@pytest.mark.parametrize("shape", [(1, 1, 7, 9), (3, 1, 5, 6), (1, 5, 6, 5), (2, 3, 4, 5)])
def test_the_grid_is_interpolated_as_it_will_be_used(shape):
    rng = np.random.default_rng(3)
    grid = GridModel(rng.standard_normal(shape), -1.5, -2.0, 0.5, -0.5 + 0.5 * np.arange(shape[0]))
    points, facing = rng.uniform(-1.6, 1.6, (300, 3)), rng.uniform(-1.0, 1.0, 300)
    expected, _ = logits(grid, points, facing)
    np.testing.assert_allclose(design_of(grid, points, facing) @ grid.logits.ravel(), expected, atol=1e-12)


def test_a_field_beyond_the_logistic_model_is_learnt_by_a_grid():
    """A lobe at the back, which no logistic model of range and bearing has."""
    truth = BeamModel(0.95, 3.0, 0.3, 0.5)

    class Lobed:
        reach, uses_facing = 8.0, False

    pairs = drawn(truth)
    lobe = np.exp(-np.sum((pairs.points[:, :2] - (-2.0, 0.5)) ** 2, axis=1) / 0.8)
    rng = np.random.default_rng(1)
    hits = np.maximum(pairs.hits, rng.binomial(4, 0.8 * lobe))
    lobed = TagPairs(**{name: getattr(pairs, name) for name in pairs.__dataclass_fields__} | {"hits": hits})
    parametric = fit_logistic(lobed, FLOOR, with_facing=False)
    grid = fit_grid(lobed, parametric, 1.0, FLOOR)
    there = np.array(((-2.0, 0.5, 0.0),))
    assert probability(parametric, there)[0] < 0.5
    assert probability(grid, there)[0] > 0.65


def test_where_there_are_no_data_the_grid_is_the_parametric_model(pairs):
    front = pairs.part(pairs.points[:, 0] > 0.0)
    parametric = fit_logistic(front, FLOOR, with_facing=True)
    grid = fit_grid(front, parametric, 5.0, FLOOR)
    behind = np.array(((-4.0, 1.0, 0.0), (-3.0, -2.0, 0.0)))
    np.testing.assert_allclose(probability(grid, behind, 0.5), probability(parametric, behind, 0.5), atol=0.05)


def test_the_way_to_fit_that_is_true_is_chosen():
    """Of reads of a logistic model with facing no grid is better by a thousandth of a nat."""
    kind, nll = choose(drawn(TRUTH, 5000), FLOOR, 1, facing=True)
    assert kind == Kind("logistic", facing=True)
    assert nll[kind] < nll[Kind("beam")] - 0.01


def test_antennas_that_differ_have_their_own_models():
    other = LogisticModel((2.5, -1.0, -0.05, -0.5, 0.1, -0.06, -0.6, -0.1, 1.9, 0.23, -0.15))
    one, two = drawn(TRUTH, 3000), drawn(other, 3000, seed=5)
    names = [name for name in one.__dataclass_fields__ if name != "antenna"]
    both = TagPairs(
        **{name: np.concatenate((getattr(one, name), getattr(two, name))) for name in names},
        antenna=np.repeat((0, 1), 3000),
    )
    assert choose(both, FLOOR, 2, facing=True)[0].own


def test_rounds_of_one_place_are_put_together(read_tags):
    """None is lost, and a robot that drives half a metre a second has at most one round of an antenna in 5 cm."""
    log = read_tags(seconds=60.0)
    apart, merged = (rounds_of(log, log.rig.rfid, merged=m) for m in (False, True))
    assert len(apart.t) == len(np.arange(0.25, 59.9, 0.25))
    assert merged.hits.sum() == apart.hits.sum() == sum(bool(epc) for epc in log.streams["rfid"].epc)
    assert merged.count.sum() == apart.count.sum()


def test_pairs_lie_where_the_factors_see_them(read_tags):
    from factors.rfid.detection import RfidLikelihood, TagArray  # noqa: PLC0415

    log = read_tags(seconds=60.0)
    rounds = rounds_of(log, log.rig.rfid)
    model = log.rig.rfid.model()
    likelihood = RfidLikelihood(model, TagArray(rounds.tags.points, rounds.tags.facing))
    expected = likelihood.probabilities(rounds.poses[:1], int(rounds.antenna[0]))[0]
    points, _ = view_of(rounds, log.rig.rfid, SurveySettings(), np.arange(len(rounds.names)))
    found = model.false_read + (1.0 - model.false_read) * probability(model.models[0], points[:, :3], points[:, 3])
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.max(expected) > 0.1


SHIFTED = SurveySettings(x=0.1, y=-0.07, heading=0.05, about_x=0.0, about_y=2.0)
PIVOT = SurveySettings(about_x=0.0, about_y=2.0)


def model_of(rounds, settings, survey):
    pairs = pairs_of(rounds, settings, survey)
    return (fit_model(pairs, logistic(pairs, with_facing=True), FLOOR)[0],), (0, 0)


def placed(log, survey=PIVOT):
    """The changes of survey and antennas, each with its standard deviation."""
    found = estimate_geometry([rounds_of(log, log.rig.rfid)], log.rig.rfid, survey, FLOOR, with_facing=True)[2]
    names = [p.name for p in found.parameters]
    return dict(zip(names, zip(found.values, found.errors, strict=True), strict=True))


def test_a_shifted_survey_is_found(read_tags):
    """Within four standard deviations each: less than one false alarm in 5,000 for the three; and they are known to
    decimetres."""
    found = placed(read_tags(seconds=400.0, survey=SHIFTED))
    for name, truth, known in (("x", 0.1, 0.1), ("y", -0.07, 0.1), ("heading", 0.05, 0.05)):
        value, error = found[f"survey.{name}"]
        assert error < known
        assert value == pytest.approx(truth, abs=4.0 * error)


def test_a_turned_antenna_is_found(read_tags):
    """By ten degrees: within one degree, or four standard deviations of the other antenna, which is right."""
    log = read_tags(seconds=900.0)
    antennas = dict(log.rig.rfid.antennas)
    antennas["left"] = antennas["left"].model_copy(update={"yaw": antennas["left"].yaw + 0.1745})
    found = placed(with_rig(log, "rfid", antennas=antennas))
    value, error = found["antennas.left.yaw"]
    assert value == pytest.approx(-0.1745, abs=max(0.0175, 2.0 * error))
    assert error < 0.05
    assert abs(found["antennas.right.yaw"][0]) < 4.0 * found["antennas.right.yaw"][1]


def test_what_is_right_is_within_chance(read_tags):
    assert all(abs(value) < 4.0 * error for value, error in placed(read_tags(seconds=200.0)).values())


def test_reads_in_bursts_need_it(read_tags):
    """Each round five times over: the share is a fifth.

    Independent ones need none: of 40 windows with three scores the mean square has a standard deviation of 0.13, and
    0.6 is beyond five of them.
    """
    log = read_tags(seconds=400.0)
    once = rounds_of(log, log.rig.rfid, merged=False)
    models, which = model_of([once], log.rig.rfid, SurveySettings())
    five = replace(once, count=5.0 * once.count, hits=5.0 * once.hits)
    alone, together = (pose_share([one], log.rig.rfid, SurveySettings(), models, which, FLOOR) for one in (once, five))
    assert alone > 0.6
    assert together == pytest.approx(min(alone / 5.0, 0.2), rel=0.2)


def learnt(logs, rig, *more):
    return rig.model_copy(update=dict(learn_rfid(logs, rig, *more).sections))


def test_a_learnt_rig_is_complete(read_tags, tmp_path):
    """With any model, a grid included, it is read back from where it was written."""
    log = read_tags(seconds=100.0)
    (tmp_path / "work").mkdir()
    kind = Kind("grid", True, own=True)
    rig = learnt([log], log.rig, tmp_path / "work" / "cart", kind)
    write_rig(rig, tmp_path / "cart.rig.toml")
    back = read_rig(tmp_path / "cart.rig.toml")
    assert all(isinstance(model, GridSettings) for model in back.rfid.models.values())
    assert {antenna.model for antenna in back.rfid.all_antennas().values()} == {"left", "right"}
    for mine, theirs in zip(rig.rfid.model().models, back.rfid.model().models, strict=True):
        np.testing.assert_array_equal(mine.logits, theirs.logits)
    assert (back.rfid.false_read, back.rfid.miss) == (0.02, 0.02)


def test_a_learnt_rig_says_what_is_made_of_strength_and_phase(read_tags, tmp_path, monkeypatch):
    """Where reads have them, and phases came into focus. What the rig says of them already stays, but for the fitted
    strength: -50 dBm with a noise of 2 dB, wherever the tag is."""
    focus = PhaseFit(SurveySettings(), (0.0, 0.0), np.full(5, 0.01), 0.5, 0.9, 2000)
    monkeypatch.setattr(rfid_learn, "fit_phase", lambda *_: focus)
    log = read_tags(seconds=40.0)
    reads = log.streams["rfid"]
    strength = np.random.default_rng(0).normal(-50.0, 2.0, len(reads.t))
    told = replace(log, streams=dict(log.streams) | {"rfid": replace(reads, rssi=strength, phase=strength * 0.0)})
    kind = Kind("logistic", True)
    rig = learnt([told], log.rig, tmp_path / "cart", kind)
    assert rig.rfid.rssi.sigma == pytest.approx(2.0, rel=0.2)
    assert rig.rfid.phase == PhaseSettings()
    assert rig.sensors == log.rig.sensors
    given = {"rssi": rig.rfid.rssi.model_copy(update={"tempering": 0.3}), "phase": PhaseSettings(kappa=2.0)}
    rig = learnt([told], rig.model_copy(update={"rfid": rig.rfid.model_copy(update=given)}), tmp_path, kind)
    assert rig.rfid.rssi.tempering == 0.3
    assert rig.rfid.phase == given["phase"]
    monkeypatch.undo()
    rig = learnt([log], log.rig, tmp_path / "cart", kind)
    assert rig.rfid.rssi is None
    assert rig.rfid.phase is None


def test_a_floor_that_the_rig_gives_is_kept(read_tags, tmp_path):
    log = read_tags(seconds=60.0)
    given = log.rig.model_copy(update={"rfid": type(log.rig.rfid)(antennas=log.rig.rfid.antennas, false_read=0.001)})
    rig = learnt([log], given, tmp_path / "cart", Kind("logistic", True))
    assert (rig.rfid.false_read, rig.rfid.miss) == (0.001, 0.0)


def test_what_cannot_be_calibrated_is_said(read_tags, tmp_path):
    log = read_tags(seconds=20.0)
    with pytest.raises(
        InputError, match=r"reads-1: has 79 inventory rounds .* expected at least 100 rounds and 2 tags"
    ):
        learn_rfid([log], log.rig, tmp_path / "cart")
    antennas = {f"{name} of the rig": antenna for name, antenna in log.rig.rfid.antennas.items()}
    renamed = log.rig.model_copy(update={"rfid": log.rig.rfid.model_copy(update={"antennas": antennas})})
    with pytest.raises(InputError, match=r"reads-1: .* use the names of the log in \[rfid.antennas\]"):
        learn_rfid([log], renamed, tmp_path / "cart")
