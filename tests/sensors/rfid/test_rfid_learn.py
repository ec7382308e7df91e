"""Survey, mounting, misplaced tags and tempering, from logs of which they are known."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.io.native.rig_file import read_rig, write_rig
from factorgraph_loc.sensors.rfid.calibration import learn as rfid_learn
from factorgraph_loc.sensors.rfid.calibration.dead import dead_tags
from factorgraph_loc.sensors.rfid.calibration.fit import Floor, Kind, fit_logistic
from factorgraph_loc.sensors.rfid.calibration.learn import learn_rfid
from factorgraph_loc.sensors.rfid.calibration.mounting import (
    SURVEY_PLACES,
    MountingConstant,
    alternated,
    moved,
    with_offsets,
)
from factorgraph_loc.sensors.rfid.calibration.pairs import pairs_of
from factorgraph_loc.sensors.rfid.calibration.phase import PhaseFit
from factorgraph_loc.sensors.rfid.calibration.rounds import rounds_of
from factorgraph_loc.sensors.rfid.calibration.tags import misplaced
from factorgraph_loc.sensors.rfid.calibration.tempering import independent_share, tempered
from factorgraph_loc.sensors.rfid.settings import GridSettings, PhaseSettings, SurveySettings

FLOOR = Floor()
KIND = Kind("logistic", facing=True)
SHIFTED = SurveySettings(x=0.3, y=-0.2, heading=0.08, about_x=0.0, about_y=2.0)


def model_of(rounds, settings, survey):
    return (fit_logistic(pairs_of(rounds, settings, survey), FLOOR, with_facing=True),), (0, 0)


def test_a_shifted_survey_is_found(read_tags):
    """Within four standard errors each: less than one false alarm in 5,000 for the three; and they are known to decimetres."""
    log = read_tags(seconds=400.0, survey=SHIFTED)
    rounds = [rounds_of(log, log.rig.rfid)]
    start = SurveySettings(about_x=0.0, about_y=2.0)
    found = alternated(rounds, log.rig.rfid, start, SURVEY_PLACES, KIND, FLOOR)
    assert np.all(found.errors < (0.1, 0.1, 0.05))
    np.testing.assert_array_less(np.abs(found.changes - (0.3, -0.2, 0.08)), 4.0 * found.errors)


def test_what_is_right_is_not_changed(read_tags):
    log = read_tags(seconds=200.0)
    rounds = [rounds_of(log, log.rig.rfid)]
    settings, survey, offsets = with_offsets(rounds, log.rig.rfid, SurveySettings(), KIND, FLOOR, focused=False)
    assert settings.all_antennas() == log.rig.rfid.all_antennas()
    assert survey == SurveySettings()
    assert not any(one.kept for one in offsets)


def test_constants_of_one_antenna_and_of_all(read_tags):
    settings = read_tags(seconds=60.0).rig.rfid
    changed, survey = moved(
        settings,
        SurveySettings(),
        (MountingConstant("x"), MountingConstant("y", -1), MountingConstant("yaw", 1)),
        np.array((0.1, 0.2, 0.3)),
    )
    left, right = changed.all_antennas().values()
    assert (survey.x, left.y, right.y) == pytest.approx((0.1, 0.4, 0.0))
    assert (left.yaw, right.yaw) == pytest.approx((np.pi / 2, 0.3 - np.pi / 2))


def test_misplaced_tags_are_named(read_tags):
    """Three tags, 1 m off, in a map of 30: at least two are named, and 0.01 of the maps name one that is in its place."""
    log = read_tags(seconds=300.0, misplaced=3)
    rounds = [rounds_of(log, log.rig.rfid)]
    found = misplaced(rounds, log.rig.rfid, SurveySettings(), *model_of(rounds, log.rig.rfid, SurveySettings()), FLOOR)
    named = {doubt.name: doubt.distance for doubt in found}
    assert set(named) <= {"tag0", "tag1", "tag2"}
    assert len(named) >= 2
    assert all(distance == pytest.approx(1.0, abs=0.4) for distance in named.values())


def test_tags_of_two_maps_are_different_ones_whatever_their_names(read_tags):
    """Of the tags of two buildings that share their names, those are named that are 1 m off in one of them."""
    logs = [read_tags(seconds=200.0, seed=1, misplaced=3), read_tags(seconds=200.0, seed=2)]
    settings, rounds = logs[0].rig.rfid, [rounds_of(log, logs[0].rig.rfid) for log in logs]
    found = misplaced(rounds, settings, SurveySettings(), *model_of(rounds, settings, SurveySettings()), FLOOR)
    assert {doubt.name for doubt in found} <= {f"tag{i} (reads-1)" for i in range(3)}
    assert found
    assert all(doubt.distance == pytest.approx(1.0, abs=0.4) for doubt in found)


def test_reads_in_bursts_need_it(read_tags):
    """Each round five times over: the share is a fifth.

    Independent ones need none: of 40 windows with three scores the mean square has a standard deviation of 0.13, and 0.6 is
    beyond five of them.
    """
    log = read_tags(seconds=400.0)
    once = rounds_of(log, log.rig.rfid, merged=False)
    models, which = model_of([once], log.rig.rfid, SurveySettings())
    five = replace(once, count=5.0 * once.count, hits=5.0 * once.hits)
    alone, together = (
        independent_share([one], log.rig.rfid, SurveySettings(), models, which, FLOOR) for one in (once, five)
    )
    assert alone > 0.6
    assert together == pytest.approx(min(alone / 5.0, 0.2), rel=0.2)


def test_tempering_is_the_square_of_a_factor(read_tags):
    rig = read_tags(seconds=60.0).rig
    assert tempered(rig, 5.0).rfid.tempering == pytest.approx(0.04)
    assert tempered(rig, 0.5).rfid.tempering == 1.0


def test_a_learnt_rig_is_complete(read_tags, tmp_path):
    """With any model, a grid included, it is read back from where it was written."""
    log = read_tags(seconds=100.0)
    (tmp_path / "work").mkdir()
    rig, knowledge = learn_rfid(
        [log], log.rig, tmp_path / "work" / "cart", Kind("grid", True, own=True, smoothness=5.0)
    )
    assert knowledge is None
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
    rig, _ = learn_rfid([told], log.rig, tmp_path / "cart", kind)
    assert rig.rfid.rssi.sigma == pytest.approx(2.0, rel=0.2)
    assert rig.rfid.phase == PhaseSettings()
    assert rig.sensors == log.rig.sensors
    given = {"rssi": rig.rfid.rssi.model_copy(update={"tempering": 0.3}), "phase": PhaseSettings(kappa=2.0)}
    rig, _ = learn_rfid([told], rig.model_copy(update={"rfid": rig.rfid.model_copy(update=given)}), tmp_path, kind)
    assert rig.rfid.rssi.tempering == 0.3
    assert rig.rfid.phase == given["phase"]
    rig, _ = learn_rfid([log], log.rig, tmp_path / "cart", kind)
    assert rig.rfid.rssi is None
    assert rig.rfid.phase is None


def test_a_floor_that_the_rig_gives_is_kept(read_tags, tmp_path):
    log = read_tags(seconds=60.0)
    given = log.rig.model_copy(update={"rfid": type(log.rig.rfid)(antennas=log.rig.rfid.antennas, false_read=0.001)})
    rig, _ = learn_rfid([log], given, tmp_path / "cart", Kind("logistic", True))
    assert (rig.rfid.false_read, rig.rfid.miss) == (0.001, 0.0)


def test_what_cannot_be_calibrated_is_said(read_tags, tmp_path):
    log = read_tags(seconds=20.0)
    with pytest.raises(InputError, match=r"reads-1: has 79 inventory rounds .* expected 100 rounds and 2 tags or more"):
        learn_rfid([log], log.rig, tmp_path / "cart")
    with pytest.raises(InputError, match=r"its rig has no RFID antennas"):
        learn_rfid([log], log.rig.model_copy(update={"rfid": None}), tmp_path / "cart")


def test_the_share_of_dead_tags(read_tags):
    """Six tags are struck off the log: they are named, and so is hardly another; the share is drawn to what is usual."""
    log = read_tags(seconds=300.0)
    rig = log.rig.model_copy(update={"rfid": log.rig.rfid.model_copy(update={"dead_tags": 0.03})})
    counts = {name: list(log.streams["rfid"].epc).count(name) for name in log.world.tags}
    gone = set(sorted(counts, key=lambda name: -counts[name])[:6])
    stream = log.streams["rfid"]
    silenced = replace(stream, epc=["" if epc in gone else epc for epc in stream.epc])
    bare = replace(log, streams={**log.streams, "rfid": silenced})
    found, sound = (dead_tags([one], [rounds_of(one, rig.rfid)], rig) for one in (bare, log))
    assert set(found.believed) >= gone
    assert len(found.believed) <= len(gone) + 1
    assert found.share == pytest.approx((len(found.believed) + 0.6) / (len(log.world.tags) + 20.0), abs=0.01)
    assert sound.share < 0.04
