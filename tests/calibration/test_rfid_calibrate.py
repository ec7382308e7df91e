"""Whole calibrations, with an estimator whose errors depend on the rig in a known way."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from factorgraph_loc.calibration import report
from factorgraph_loc.calibration.calibrate import calibrate
from factorgraph_loc.calibration.held_out import growth
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.sensors.rfid.settings import BeamSettings
from factorgraph_loc.sensors.smoothed import recordings


def outcome(error, anees=3.0):
    kinds = {f"{kind}.{name}": error for kind in ("causal", "final") for name in ("position_rmse", "heading_rmse")}
    scores = kinds | {"causal.anees": anees, "final.anees": anees, "causal.scored": 1000, "final.scored": 1000}
    diagnostics = Diagnostics(doubted={"moved_tags": {"tag3": 0.9}, "dead_tags": {}})
    return SimpleNamespace(scores=scores, result=SimpleNamespace(diagnostics=diagnostics))


@pytest.fixture(scope="module")
def logs(read_tags):
    made = [read_tags(seed=seed, seconds=70.0) for seed in (1, 2)]
    rfid = made[0].rig.rfid.model_copy(update={"models": {"default": BeamSettings(p0=0.8)}})
    rig = made[0].rig.model_copy(update={"rfid": rfid})
    return [replace(log, rig=rig) for log in made]


def calibrated(logs, folder, factor, anees=3.0):
    """With an estimator whose error is that many times larger with any rig but that of the logs, and whose ANEES is another."""
    runs = []

    def run(log, estimator):
        runs.append((log.name, estimator, log.rig))
        return outcome(0.1) if log.rig == logs[0].rig else outcome(0.1 * factor, anees)

    return calibrate(logs, run, grids=folder / "cart"), runs


def test_each_log_is_tried_with_a_rig_from_the_others(logs, tmp_path):
    calibration, runs = calibrated(logs, tmp_path, 0.5)
    assert not calibration.refused
    assert calibration.rig == calibration.knowledge.rig != logs[0].rig
    assert growth(calibration.trials) == pytest.approx(0.5)
    assert [(t.log, t.estimator) for t in calibration.trials] == [
        (log.name, estimator) for log in logs for estimator in ("ekf", "smoother")
    ]
    learnt = {name: rig for name, _, rig in runs if rig != logs[0].rig}
    assert calibration.rig not in learnt.values()
    assert learnt["reads-1"] != learnt["reads-2"]
    assert any("moved tags tag3" in str(doubt) for doubt in calibration.doubts)


@pytest.mark.parametrize(
    ("factor", "anees", "refused"),
    [(1.01, 3.0, False), (1.05, 3.0, True), (0.95, 3.5, False), (0.95, 7.0, True), (0.7, 7.0, False)],
)
def test_a_rig_with_larger_or_less_consistent_errors_is_refused(logs, tmp_path, factor, anees, refused):
    calibration, _ = calibrated(logs, tmp_path, factor, anees)
    assert bool(calibration.refused) == refused
    assert calibration.rig == (calibration.input_rig if refused else calibration.knowledge.rig)
    assert any(doubt.kind == "refused" for doubt in calibration.doubts) == refused
    assert ("input rig is kept" in report.summary(calibration)[-1]) == refused


def test_logs_with_the_same_reads_are_one_recording(logs, tmp_path):
    """Its halves are held out, as those of a single log."""
    again = replace(logs[0], name="again")
    assert len(set(recordings([logs[0], again, logs[1]]))) == 2
    calibration, _ = calibrated([logs[0], again], tmp_path, 0.5)
    assert [t.log for t in calibration.trials if t.estimator == "ekf"] == ["reads-1", "again"] * 2
