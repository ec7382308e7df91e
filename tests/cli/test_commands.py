"""Commands that run no estimator, and how all of them print."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from factorgraph_loc import __version__
from factorgraph_loc.cli import show
from factorgraph_loc.evaluation.tables import COLUMNS, comparison_cells, comparison_table


def test_version_and_help(fgloc):
    assert fgloc("--version").stdout == f"fgloc {__version__}\n"
    text = fgloc("--help").stdout
    for command in ("datasets", "info", "convert", "run", "compare"):
        assert command in text
        assert fgloc(command, "--help").exit_code == 0


@pytest.mark.parametrize("args", [["--help"], ["--version"], ["run", "--help"]])
def test_help_does_not_load_numerical_libraries(args):
    code = (
        "import sys, factorgraph_loc.cli.main as m\n"
        f"sys.argv[1:] = {args!r}\n"
        "try: m.main()\n"
        "except SystemExit: pass\n"
        "print(sorted({'numpy', 'gtsam', 'matplotlib', 'polars', 'scipy'} & set(sys.modules)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.endswith("[]\n")


def test_datasets(fgloc):
    result = fgloc("datasets")
    assert result.exit_code == 0
    for name in ("plaza2", "mrclam6-robot1"):
        assert name in result.stdout
    names = [entry["name"] for entry in json.loads(fgloc("datasets", "--json").stdout)]
    assert "plaza2" in names


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_convert(fgloc, short_log, tmp_path, kind):
    out = tmp_path / "copy"
    result = fgloc("convert", short_log, out, "--format", kind)
    assert result.exit_code == 0
    assert str(out) in result.stdout
    assert (out / f"odometry.{kind}").is_file()
    one, other = (json.loads(fgloc("info", log, "--json").stdout) for log in (short_log, out))
    assert one["streams"] == other["streams"]


def test_convert_overwrites_a_log_alone(fgloc, short_log, tmp_path):
    out = tmp_path / "copy"
    assert fgloc("convert", short_log, out).exit_code == 0
    assert fgloc("convert", short_log, out, "--format", "parquet").exit_code == 2
    assert fgloc("convert", short_log, out, "--format", "parquet", "--overwrite").exit_code == 0
    assert (out / "odometry.parquet").is_file()
    assert not (out / "odometry.csv").exists()
    assert [path.name for path in tmp_path.glob(".*")] == []
    (out / "notes.md").write_text("mine")
    assert "holds notes.md beside its log" in fgloc("convert", short_log, out, "--overwrite").stderr
    (out / "run.toml").unlink()
    refused = fgloc("convert", short_log, out, "--overwrite")
    assert refused.exit_code == 2
    assert "expected a new one, or one with a log in the native format to overwrite" in refused.stderr
    assert (out / "notes.md").read_text() == "mine"


def test_a_pipe_gets_plain_text(short_log, tmp_path):
    """A comparison as it is given to a shell, with processes of its own and all pictures."""
    command = [sys.executable, "-c", "from factorgraph_loc.cli.main import main; main()"]
    arguments = ["compare", str(short_log), "-e", "dead_reckoning", "-o", str(tmp_path / "out")]
    done = subprocess.run([*command, *arguments], capture_output=True, text=True, check=True)
    assert "\x1b" not in done.stdout + done.stderr
    assert done.stderr == ""
    assert Path(tmp_path / "out/results.csv").is_file()


@pytest.mark.parametrize("columns", [40, 80, 200])
def test_a_narrow_terminal_cuts_nothing_off(columns, capsys, monkeypatch):
    scores = {key: 31.494 for key, _, _ in COLUMNS.values()}
    row = {"log": "plaza2", "estimator": "dead_reckoning", "seed": 0, "status": "ok", "time_to_localized": 0.0} | scores
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setattr("shutil.get_terminal_size", lambda **_: os.terminal_size((columns, 24)))
    show.rich_table(comparison_table([row]))
    text = capsys.readouterr().out
    assert "…" not in text
    line = next(line for line in text.splitlines() if "plaza2" in line).split()
    assert line == ["plaza2", "dead_reckoning", *comparison_cells([row])[1][0][2:]]
