"""Models of detection fitted to reads that a known model made."""

import numpy as np
import pytest

from factorgraph_loc.sensors.rfid.calibration.fields import Kind, choose, design_of, fit_grid
from factorgraph_loc.sensors.rfid.calibration.pairs import Floor, TagPairs, view_of
from factorgraph_loc.sensors.rfid.calibration.parametric import FACING, beam, fit_model, logistic
from factorgraph_loc.sensors.rfid.calibration.rounds import rounds_of
from factorgraph_loc.sensors.rfid.settings import SurveySettings
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
