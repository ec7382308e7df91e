"""Survey, mounting and tempering, from logs of which they are known."""

from dataclasses import replace

import numpy as np
import pytest
from changed_logs import with_rig

from factorgraph_loc import InputError, read_rig, write_rig
from factorgraph_loc.sensors.rfid.calibration import learn as rfid_learn
from factorgraph_loc.sensors.rfid.calibration.fields import Kind
from factorgraph_loc.sensors.rfid.calibration.learn import learn_rfid, pose_share
from factorgraph_loc.sensors.rfid.calibration.pairs import Floor, pairs_of
from factorgraph_loc.sensors.rfid.calibration.parametric import fit_model, logistic, place
from factorgraph_loc.sensors.rfid.calibration.phase import PhaseFit
from factorgraph_loc.sensors.rfid.calibration.rounds import rounds_of
from factorgraph_loc.sensors.rfid.settings import GridSettings, PhaseSettings, SurveySettings

FLOOR = Floor()
SHIFTED = SurveySettings(x=0.1, y=-0.07, heading=0.05, about_x=0.0, about_y=2.0)
PIVOT = SurveySettings(about_x=0.0, about_y=2.0)


def model_of(rounds, settings, survey):
    pairs = pairs_of(rounds, settings, survey)
    return (fit_model(pairs, logistic(pairs, with_facing=True), FLOOR)[0],), (0, 0)


def placed(log, survey=PIVOT):
    """The changes of survey and antennas, each with its standard deviation."""
    found = place([rounds_of(log, log.rig.rfid)], log.rig.rfid, survey, FLOOR, with_facing=True)[2]
    names = [p.name for p in found.parameters]
    return dict(zip(names, zip(found.values, found.errors, strict=True), strict=True))


def test_a_shifted_survey_is_found(read_tags):
    """Within four standard deviations each: less than one false alarm in 5,000 for the three; and they are known to decimetres."""
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

    Independent ones need none: of 40 windows with three scores the mean square has a standard deviation of 0.13, and 0.6 is
    beyond five of them.
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
    """Where reads have them, and phases came into focus. What the rig says of them already stays, but for the fitted strength: -50
    dBm with a noise of 2 dB, wherever the tag is."""
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
    with pytest.raises(InputError, match=r"reads-1: has 79 inventory rounds .* expected 100 rounds and 2 tags or more"):
        learn_rfid([log], log.rig, tmp_path / "cart")
    antennas = {f"{name} of the rig": antenna for name, antenna in log.rig.rfid.antennas.items()}
    renamed = log.rig.model_copy(update={"rfid": log.rig.rfid.model_copy(update={"antennas": antennas})})
    with pytest.raises(InputError, match=r"reads-1: .* same names in \[rfid.antennas\]"):
        learn_rfid([log], renamed, tmp_path / "cart")
