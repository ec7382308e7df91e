"""Logs of a robot in space on the command line."""

import json

import numpy as np

from factorgraph_loc.model.trajectory3 import Trajectory3


def test_the_command_tells_how_far_off_in_space(data_root, tmp_path, fgloc):
    arguments = ["run", "starry_night", "-e", "monoslam", "--sensors", "twist", "-o", tmp_path / "run"]
    found = fgloc(*arguments, "--data-root", data_root)
    assert found.exit_code == 0, found.output
    assert "in space" in found.output
    assert "rotation RMSE [rad]" in found.output
    final = Trajectory3.read(tmp_path / "run" / "final.tum")
    assert np.ptp(final.positions[:, 2]) > 0.1
    assert np.abs(final.rotations[:, 2, 2]).min() < 0.95  # it is tilted
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["causal.space_position_rmse"] > 0.1


def test_info_tells_of_the_reference(data_root, fgloc):
    found = fgloc("info", "starry_night", "--data-root", data_root)
    assert found.exit_code == 0, found.output
    assert "three-dimensional, 1900 poses" in found.output
