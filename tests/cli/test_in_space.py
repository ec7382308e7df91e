"""Logs of a robot in space on the command line."""

import json


def test_the_command_tells_how_far_off_in_space(data_root, tmp_path, fgloc):
    arguments = ["run", "starry_night", "-e", "monoslam", "--sensors", "twist", "-o", tmp_path / "run"]
    found = fgloc(*arguments, "--data-root", data_root)
    assert found.exit_code == 0, found.output
    assert "in space" in found.output
    assert "rotation RMSE [rad]" in found.output
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["causal.space_position_rmse"] > 0.1


def test_info_tells_of_the_reference(data_root, fgloc):
    found = fgloc("info", "starry_night", "--data-root", data_root)
    assert found.exit_code == 0, found.output
    assert "three-dimensional, 1900 poses" in found.output
