"""``fgloc view``: which log and which runs are meant."""

import sys

import pytest

from factorgraph_loc.exports import rerun_viewer

pytest.importorskip("rerun")


@pytest.fixture(scope="module")
def run_folder(short_log, tmp_path_factory):
    from factorgraph_loc.experiments.output import write_run  # noqa: PLC0415
    from factorgraph_loc.experiments.run import RunConfig, run  # noqa: PLC0415
    from factorgraph_loc.io.readers import load  # noqa: PLC0415

    (log,) = load(str(short_log))
    out = tmp_path_factory.mktemp("view") / "ekf"
    write_run(run(log, RunConfig("ekf")), log, out)
    return out


@pytest.mark.parametrize("with_run", [False, True])
def test_a_file_for_the_viewer(fgloc, short_log, run_folder, tmp_path, with_run):
    out = tmp_path / "view.rrd"
    result = fgloc("view", *([run_folder] if with_run else []), short_log, "--rrd", out)
    assert result.exit_code == 0, result.stderr
    assert result.stdout == f"wrote {out}: open it with rerun --bind 127.0.0.1 {out}\n"
    assert out.read_bytes()[:4] == b"RRF2"


def test_a_viewer_that_does_not_start(refused, short_log, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(rerun_viewer, "_is_listening", lambda _: False)
    monkeypatch.setattr(rerun_viewer, "COMMAND", (sys.executable, "-c", "raise SystemExit(1)"))
    assert "the viewer did not start; --rrd FILE writes a file" in refused("view", short_log)
