"""Calibrations that would make an estimator worse, and what is left of them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from factorgraph_loc.api import learning
from factorgraph_loc.calibration import report
from factorgraph_loc.calibration.calibrate import calibrate
from factorgraph_loc.calibration.held_out import Fold
from factorgraph_loc.calibration.selection import Bench
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import Unit
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factorgraph_loc.sensors.rfid.settings import BeamSettings, SurveySettings

SECONDS = 100.0
KEYS = ("causal.position_rmse", "final.position_rmse")


@pytest.fixture(scope="module")
def skewed(simulate):
    """``skewed(seed)``: a log of ranges alone, two in five too long, by a metre on average, and a rig whose sensor is right."""

    def make(seed):
        log = simulate(seed=seed, seconds=SECONDS, range_sigma=0.05, scale_distance=0.85)
        rng = np.random.default_rng(100 + seed)
        seen = log.streams["bearing_range"]
        count = len(seen.range)
        late = np.where(rng.random(count) < 0.4, rng.exponential(1.0, count), 0.0)
        ranges = replace(seen, range=seen.range + late, bearing=np.full(count, np.nan))
        rig = Rig(name="skewed", bearing_range=BearingRangeSettings(range_sigma=0.1))
        return replace(log, rig=rig, streams={**log.streams, "bearing_range": ranges})

    return make


@pytest.fixture(scope="module")
def calibrated(skewed):
    log = skewed(1)
    return log, calibrate([log], learning._score)


def test_skewed_ranges_make_no_estimator_worse(skewed, calibrated):
    """Neither where the rig was learnt nor elsewhere, where the fit's own choice is two to three times as far off."""
    log, found = calibrated
    assert found.rig.bearing_range.range_scale == 1.0
    assert found.rig.bearing_range.range_sigma == 0.1
    for one in (log, skewed(2)):
        before, after = (learning._score(replace(one, rig=rig)) for rig in (log.rig, found.rig))
        for key in KEYS:
            assert after[key] < 1.02 * before[key]


def test_what_helps_is_kept_beside_what_does_not(calibrated):
    _, found = calibrated
    assert found.rig.odometry.scale_distance == pytest.approx(0.85, abs=0.01)
    assert found.judgement("odometry.scale_distance").accepted
    assert not found.judgement("bearing_range.range_scale").accepted


def test_the_report_lists_accepted_and_refused_with_their_figures(calibrated):
    _, found = calibrated
    header, rows = report.judgements_table(found)
    verdicts = {row[0]: row[1] for row in rows}
    assert verdicts["odometry.scale_distance"] == "accepted"
    assert verdicts["bearing_range.range_scale"] == "refused"
    assert {len(row) for row in rows} == {len(header)}
    whys = {c.name: c.why for c in found.knowledge.constants if c.sensor == "bearing_range"}
    assert whys["range_scale"].startswith("refused")
    page = report.page(found)
    assert all(name in page for name in ("refused", "accepted", "new position RMSE [m]"))
    judgements = report.document(found)["judged"]
    assert {name for one in judgements for name in one["parameters"]} >= {"bearing_range.range_scale", "odometry.noise"}
    assert all(one["new"]["causal.position_rmse"] > 0.0 for one in judgements)


def scores(position):
    found = {f"{kind}.{name}": 0.1 for kind in ("causal", "final") for name in ("heading_rmse", "anees")}
    found |= {f"{kind}.position_rmse": position for kind in ("causal", "final")}
    return found | {"causal.scored": 1000, "final.scored": 1000}


def test_if_nothing_pays_the_rig_is_that_of_the_input(simulate):
    """Though the fits find much, the estimator is best as it was."""
    log = simulate(seconds=70.0, scale_distance=0.9, range_scale=1.05)
    found = calibrate([log], lambda one: scores(0.1 if one.rig == log.rig else 0.2))
    assert found.rig == log.rig
    assert found.after == found.before
    assert not any(one.accepted for one in found.judgements)
    assert {"odometry.scale_distance", "bearing_range.range_scale"} <= {
        n for one in found.judgements for n in one.names
    }
    assert not any(c.kept for c in found.knowledge.constants)


def test_a_stretch_is_run_once_with_each_rig(simulate):
    """Whatever parameters that rig comes from, until something else is learnt."""
    log, runs = simulate(seconds=30.0), []
    same, rigs = Unit("odometry", ("delay",)), {0: log.rig, 1: log.rig.model_copy(update={"name": "other"})}
    learner = SimpleNamespace(rig=lambda state: rigs[sum(unit != same for unit in state)])
    bench = Bench([Fold(0, (), (log,))], [learner], lambda one: runs.append(one.rig.name) or scores(0.1))
    for unit in (same, Unit("odometry", ("scale_distance",))):
        bench.outcome(frozenset())
        bench.outcome(frozenset({unit}))
    assert runs == ["unknown", "other"]
    bench.forget()
    bench.outcome(frozenset())
    assert runs == ["unknown", "other", "unknown"]


def test_a_survey_that_the_estimator_does_not_like_is_not_shifted(read_tags, tmp_path):
    """The reads' likelihood finds a shift; it is refused, and the model is learnt with the tags at their old places."""
    survey = SurveySettings(x=0.6, y=-0.4)
    log = read_tags(seconds=70.0, survey=survey)
    rfid = log.rig.rfid.model_copy(update={"models": {"default": BeamSettings(p0=0.8)}})
    rig = log.rig.model_copy(update={"rfid": rfid})

    def evaluate(one):
        shifted = one.rig.survey != SurveySettings() or one.rig.rfid.antennas["left"] != rfid.antennas["left"]
        learnt = one.rig.rfid.models != rfid.models
        return scores(0.2 * (0.5 if learnt else 1.0) * (1.0 if not shifted else 3.0))

    found = calibrate([log], evaluate, rig, grids=tmp_path / "cart")
    assert any(o.name == "x" and o.change > 0.3 for o in found.knowledge.found["rfid"].knowledge.offsets)
    assert not any(o.kept for o in found.knowledge.found["rfid"].knowledge.offsets)
    assert found.rig.survey == rig.survey
    places = [(a.x, a.y, a.yaw) for a in found.rig.rfid.antennas.values()]
    assert places == [(a.x, a.y, a.yaw) for a in rfid.antennas.values()]
    assert found.rig.rfid.models != rfid.models
    assert not found.judgement("rfid.places").accepted
    assert found.judgement("rfid.models").accepted
