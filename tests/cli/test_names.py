"""Names of logs and landmarks are whatever others wrote: results are made, and no terminal obeys what is printed of them."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from factorgraph_loc import BearingRangeStream, IncrementStream, Landmark, Log, Rig, Trajectory, World, write_native
from factorgraph_loc.cli import show
from factorgraph_loc.cli.app import app
from factorgraph_loc.evaluation.tables import comparison_cells
from factorgraph_loc.files.models import read_toml, write_toml
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings

RIG = Rig(sensors=("odometry", "bearing_range"), bearing_range=BearingRangeSettings(range_sigma=0.1))


def named(name: str, landmark: str) -> Log:
    """Two seconds of driving straight on, past a landmark."""
    t = np.arange(20) * 0.1
    x = 0.05 * np.arange(20)
    sightings = BearingRangeStream(t, [landmark] * 20, np.hypot(5.0 - x, 2.0), np.arctan2(2.0, 5.0 - x))
    streams = {"odometry": IncrementStream(t, np.full(20, 0.05), 0.0 * t, 0.0 * t), "bearing_range": sightings}
    reference = Trajectory(t, np.column_stack((x, 0.0 * x, 0.0 * x)))
    return Log(name, RIG, World(landmarks={landmark: Landmark(x=5.0, y=2.0)}), streams, reference)


def shown(text: str) -> bool:
    """Whether a terminal shows all of it."""
    return all(c == "\n" or c.isprintable() for c in text)


@pytest.mark.parametrize(
    ("name", "landmark"), [("a $x^{$ b\x1b[31m\u202e\n" + "n" * 300, "$$\x1b[2J"), ("caf\udce9", "\x9b")]
)
def test_any_name_gives_a_run_with_tables_and_plots(name: str, landmark: str, tmp_path: Path) -> None:
    """How names are drawn is tested in ``tests/drawing``."""
    log, out = tmp_path / "log", tmp_path / "out"
    write_native(named(name, landmark), log)
    compared = ["compare", log, "-e", "dead_reckoning,ekf", "-o", tmp_path / "compared"]
    for command in (["info", log], ["info", log, "--json"], ["run", log, "-e", "ekf", "-o", out], compared):
        done = CliRunner().invoke(app, [str(word) for word in command])
        assert done.exit_code == 0, done.output
        assert shown(done.stdout + done.stderr)
    assert read_toml(out / "config.toml")
    assert json.loads((out / "metrics.json").read_text())
    assert list((out / "plots").glob("*.png"))
    for file in ("report.html", "table.md", "results.csv"):
        assert not {"\x1b", "\u202e", "\x9b"} & set((tmp_path / "compared" / file).read_text())


@pytest.mark.parametrize("name", ["\x1b[31m\x00\u202e\x9b", "a\nb", "caf\udce9", "[/red]:smile:{x}"])
def test_whatever_is_printed_goes_through_one_function(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    row = {"log": name, "estimator": name, "seed": 0, "status": "ok"}
    show.table(*comparison_cells([row]), grouped=True)
    show.table(["name"], [[name]])
    show.fields({"name": name})
    show.document({name: name})
    show.note(name)
    show.warnings([name * 500])
    with show.progress(name, counted=True) as bar:
        bar(1, 2, name)
    out, err = capsys.readouterr()
    assert shown(out + err)
    assert max(map(len, err.splitlines())) <= 320
    assert ":smile:" in out or "\\" in out


def test_toml_holds_file_names_that_are_not_utf_8(tmp_path: Path) -> None:
    write_toml(tmp_path / "a.toml", {"log": "caf\udce9", "name": "\x1b\u202e"})
    assert read_toml(tmp_path / "a.toml") == {"log": "caf\\udce9", "name": "\x1b\u202e"}


def test_a_long_command_prints_its_expected_duration_once_in_a_pipe(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(show, "perf_counter", iter((0.0, 5.0, 10.0, 15.0)).__next__)
    with show.progress("runs", counted=True) as report:
        for done in range(1, 4):
            report(done, 60)
    assert capsys.readouterr().err == "runs: takes about 5 min\n"


def test_a_short_command_prints_no_duration_in_a_pipe(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(show, "perf_counter", iter((0.0, 5.0, 10.0)).__next__)
    with show.progress("runs", counted=True) as report:
        report(1, 2)
        report(2, 2)
    assert capsys.readouterr().err == ""
