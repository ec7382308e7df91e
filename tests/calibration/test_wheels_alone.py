"""Calibration of wheels against a reference without another sensor: radius and track."""

from dataclasses import replace

import pytest

import factorgraph_loc as fgloc
from factorgraph_loc.calibration import report
from factorgraph_loc.calibration.held_out import growth
from factorgraph_loc.sensors.odometry.settings import DifferentialDrive

RADIUS, TRACK = 0.1, 0.5  # m, as the log was converted


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("wheels") / "cart.rig.toml"


@pytest.fixture(scope="module")
def calibrated(simulate, file):
    """From two drives with wheels that are 6 % larger and 4 % further apart than in the rig."""
    logs = []
    for seed in (1, 2):
        log = simulate(seed=seed, seconds=120.0, scale_distance=1.06, scale_rotation=1.06 / 1.04)
        rig = log.rig.model_copy(update={"bearing_range": None, "sensors": ("odometry",)})
        wheels = rig.odometry.model_copy(update={"wheels": DifferentialDrive(radius=RADIUS, track=TRACK)})
        odometry = {"odometry": log.streams["odometry"]}
        logs.append(replace(log, rig=rig.model_copy(update={"odometry": wheels}), streams=odometry))
    return fgloc.calibrate(logs, file)


def test_radius_and_track_are_found(calibrated):
    wheels = report.document(calibrated)["figures"]["odometry"]
    assert wheels["radius"] == pytest.approx(1.06 * RADIUS, rel=0.01)
    assert wheels["track"] == pytest.approx(1.04 * TRACK, rel=0.015)
    assert calibrated.rig.odometry.wheels == DifferentialDrive(radius=RADIUS, track=TRACK)
    assert "radius" in report.page(calibrated)


def test_rig_and_report_are_written_once(calibrated, file):
    assert fgloc.read_rig(file).odometry == calibrated.rig.odometry
    assert file.with_name("cart.report.html").is_file()
    with pytest.raises(fgloc.InputError, match="exists already"):
        fgloc.calibrate([], file)


def test_dead_reckoning_gains_by_it(calibrated):
    assert len(calibrated.trials) == 4
    assert growth(calibrated.trials) < 0.75
    lines = report.summary(calibrated)
    assert any("odometry.scale_distance 1.0000 -> 1.0" in line for line in lines)
    assert lines[-1].endswith("times those with the input rig")


def test_a_reference_without_headings_calibrates_no_wheels(simulate, tmp_path):
    log = simulate(seconds=60.0)
    log = replace(log, streams={"odometry": log.streams["odometry"]})
    log = replace(log, reference=replace(log.reference, has_heading=False))
    with pytest.raises(
        fgloc.InputError, match="expected one of them, or headings in the reference, to calibrate wheels alone"
    ):
        fgloc.calibrate(log, tmp_path / "cart.rig.toml")
