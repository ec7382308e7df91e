"""``fgloc export`` and ``fgloc view``: files for other programs, by their suffix, and which log and which runs are meant."""

import json
import sys

import numpy as np
import polars as pl
import pytest
from evo.tools import file_interface
from tum_files import read_tum

from factorgraph_loc.experiments.output import write_run
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.exports import rerun_viewer
from factorgraph_loc.io.readers import load


@pytest.fixture(scope="module")
def comparison(short_log, tmp_path_factory):
    (log,) = load(str(short_log))
    out = tmp_path_factory.mktemp("export")
    for name in ("dead_reckoning", "ekf"):
        write_run(run(log, RunConfig(name)), log, out / "store" / name[:2] / name)
    pl.DataFrame({"key": ["dead_reckoning", "ekf"], "status": ["ok", "ok"]}).write_parquet(out / "results.parquet")
    return out


@pytest.fixture
def ekf(comparison):
    return comparison / "store" / "ek" / "ekf"


def test_trajectories(fgloc, short_log, ekf, tmp_path):
    result = fgloc("export", ekf, short_log, "-o", tmp_path / "ekf.kitti")
    assert result.stdout == f"wrote {tmp_path / 'ekf.kitti'} and {tmp_path / 'ekf.times.txt'}\n"
    result = fgloc("export", ekf, short_log, "-o", tmp_path / "ekf.tum", "--json")
    assert json.loads(result.stdout) == {
        "log": "short",
        "runs": {"ekf": str(ekf)},
        "files": [str(tmp_path / "ekf.tum")],
    }
    final = read_tum(ekf / "final.tum")
    assert np.array_equal(read_tum(tmp_path / "ekf.tum").poses, final.poses)
    kitti = file_interface.read_kitti_poses_file(str(tmp_path / "ekf.kitti"))
    assert np.allclose(kitti.positions_xyz[:, :2], final.poses[:, :2], atol=1e-8)


def test_the_reference_of_a_log(fgloc, short_log, tmp_path):
    assert fgloc("export", short_log, "-o", tmp_path / "truth.tum").exit_code == 0
    (log,) = load(str(short_log))
    assert np.allclose(read_tum(tmp_path / "truth.tum", log.t0_ns).poses[:, :2], log.reference.poses[:, :2], atol=1e-8)


def test_all_runs_for_foxglove_and_rviz(fgloc, short_log, comparison, tmp_path):
    assert fgloc("export", comparison, short_log, "-o", tmp_path / "short.mcap").exit_code == 0
    assert (tmp_path / "short.mcap").read_bytes()[:5] == b"\x89MCAP"


def test_bad_input(refused, short_log, comparison, ekf, tmp_path):
    assert "has the suffix '.csv', expected one of" in refused("export", ekf, short_log, "-o", "a.csv")
    several = refused("export", comparison, short_log, "-o", tmp_path / "a.tum")
    assert "2 runs are given (dead_reckoning, ekf)" in several
    bare = tmp_path / "bare"
    bare.mkdir()
    for file in short_log.iterdir():
        if file.stem != "reference":
            (bare / file.name).write_bytes(file.read_bytes())
    assert "has no reference to write" in refused("export", bare, "-o", tmp_path / "a.tum")


@pytest.mark.parametrize("with_run", [False, True])
def test_a_file_for_the_viewer(fgloc, short_log, ekf, tmp_path, with_run):
    pytest.importorskip("rerun")
    out = tmp_path / "view.rrd"
    result = fgloc("view", *([ekf] if with_run else []), short_log, "--rrd", out)
    assert result.exit_code == 0, result.stderr
    assert result.stdout == f"wrote {out}: open it with rerun --bind 127.0.0.1 {out}\n"
    assert out.read_bytes()[:4] == b"RRF2"


def test_a_viewer_that_does_not_start(refused, short_log, monkeypatch):
    pytest.importorskip("rerun")
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(rerun_viewer, "_is_listening", lambda _: False)
    monkeypatch.setattr(rerun_viewer, "COMMAND", (sys.executable, "-c", "raise SystemExit(1)"))
    assert "the viewer did not start: use --rrd FILE to write a file" in refused("view", short_log)
