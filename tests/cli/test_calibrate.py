"""``fgloc calibrate`` on a minute of a real log."""

import json
from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc import StartPose, load, read_rig, write_native


@pytest.fixture(scope="module")
def calibrated(fgloc_once, short_log, tmp_path_factory):
    """The rig of the short log, its report, and what was printed."""
    out = tmp_path_factory.mktemp("rigs") / "mower.rig.toml"
    result = fgloc_once("calibrate", short_log, "-o", out)
    assert result.exit_code == 0, result.output
    return out, out.with_name("mower.report.html"), result


def test_the_rig_is_complete_and_runs(fgloc, short_log, calibrated, tmp_path):
    out, _, _ = calibrated
    rig = read_rig(out)
    assert rig.bearing_range.range_scale == pytest.approx(1.0697, abs=0.01)
    result = fgloc("run", short_log, "-e", "ekf", "--rig", out, "-o", tmp_path / "run", "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["causal.position_rmse"] < 0.5


def test_what_was_learnt_is_said_in_a_few_lines(calibrated):
    """A minute is too short to hold out half of it, so that the rig stays as it was."""
    _, report, result = calibrated
    lines = result.stdout.splitlines()
    assert len(lines) < 12
    assert any("bearing_range.range_scale" in line for line in lines)
    assert lines[-2] == "the input rig is kept: the logs are too short to hold out parts of them"
    assert "bearing_range.range_scale" in report.read_text()


def test_a_log_without_reference_is_calibrated_by_itself(fgloc, refused, short_log, tmp_path):
    """Of ranges and wheels, the constants that the input rig is uncertain of; in place of what was there."""
    (log,) = load(str(short_log))
    reference, blind, out = log.reference, tmp_path / "blind", tmp_path / "a.rig.toml"
    start = StartPose(reference.t[0], reference.poses[0], np.full(3, 0.1))
    write_native(replace(log, reference=None, start=start), blind)
    out.write_text("old")
    result = fgloc("calibrate", blind, "-o", out, "--overwrite")
    assert result.exit_code == 0
    assert "learnt without a reference, in" in result.stdout
    assert "in turns" in (tmp_path / "a.report.html").read_text()
    assert "range_sigma" in out.read_text()
    mixed = refused("calibrate", short_log, blind, "-o", tmp_path / "b.rig.toml")
    assert "has no reference, expected one to calibrate against" in mixed
