"""Commands that run no estimator, and how all of them print."""

import json
import re
import subprocess
import sys

import pytest
from typer.main import get_command

from factorgraph_loc import __version__
from factorgraph_loc.cli.app import app


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


def test_convert_overwrites_a_log_alone(fgloc, refused, short_log, tmp_path):
    out = tmp_path / "copy"
    assert fgloc("convert", short_log, out).exit_code == 0
    assert fgloc("convert", short_log, out, "--format", "parquet").exit_code == 2
    assert fgloc("convert", short_log, out, "--format", "parquet", "--overwrite").exit_code == 0
    assert (out / "odometry.parquet").is_file()
    assert not (out / "odometry.csv").exists()
    assert [path.name for path in tmp_path.glob(".*")] == []
    (out / "notes.md").write_text("mine")
    assert "contains notes.md, not part of its log" in refused("convert", short_log, out, "--overwrite")
    (out / "run.toml").unlink()
    assert "expected a new one, or one with a log" in refused("convert", short_log, out, "--overwrite")
    assert (out / "notes.md").read_text() == "mine"


WITHOUT_FILES = {"datasets", "estimators", "readers", "sensors", "presets", "policies", "rigs show"}


def leaves(command, *names):
    """The commands that have no subcommands, by their names."""
    children = getattr(command, "commands", {})
    return [leaf for name, child in children.items() for leaf in leaves(child, *names, name)] or [(names, command)]


@pytest.mark.parametrize(("names", "command"), leaves(get_command(app)), ids=str)
def test_every_command_shows_an_example_that_it_accepts(fgloc, names, command):
    help_text = fgloc(*names, "--help").stdout
    (example,) = re.findall(rf"Example: fgloc {' '.join(names)}\s*([^>;]*?)(?:[>;].*?)?\n\n", help_text, re.DOTALL)
    command.make_context(names[-1], example.split())  # raises for an unknown option or a missing argument
    if " ".join(names) in WITHOUT_FILES:
        assert fgloc(*names, *example.split()).exit_code == 0
