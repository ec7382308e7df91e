"""Commands that run no estimator, and how all of them print."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator

import cv2
import pytest
from typer.main import get_command

from factorgraph_loc import FglocError, InputError, RunFailedError, __version__
from factorgraph_loc.cli.app import app
from factorgraph_loc.cli.main import main
from factorgraph_loc.cli.options import parse_settings
from factorgraph_loc.model.scoring import parse_seeds


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


def test_convert_overwrites_a_log_alone(fgloc, refused, short_log, tmp_path):
    out = tmp_path / "copy"
    assert fgloc("convert", short_log, out).exit_code == 0
    assert fgloc("convert", short_log, out, "--format", "parquet").exit_code == 2
    assert fgloc("convert", short_log, out, "--format", "parquet", "--overwrite").exit_code == 0
    assert (out / "odometry.parquet").is_file()
    assert not (out / "odometry.csv").exists()
    assert [path.name for path in tmp_path.glob(".*")] == []
    (out / "notes.md").write_text("mine")
    assert "contains notes.md, which overwriting would delete" in refused("convert", short_log, out, "--overwrite")
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


def commands(group: object, name: str = "fgloc") -> Iterator[tuple[str, object]]:
    """Every command that does something, by its full name."""
    for word, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, f"{name} {word}")
        else:
            yield f"{name} {word}", command


@pytest.mark.parametrize(("name", "command"), list(commands(get_command(app))))
def test_every_command_can_print_json(name, command):
    assert "--json" in {option for parameter in command.params for option in parameter.opts}, name


def test_convert_and_simulate_print_json_alone(fgloc, tmp_path):
    made = json.loads(fgloc("simulate", "office", "-o", tmp_path / "one", "--duration", 5, "--json").stdout)
    assert made == {"log": "office-0", "seed": 0, "span": 5.0, "folder": str(tmp_path / "one")}
    several = fgloc("simulate", "office", "-o", tmp_path / "logs", "--duration", 5, "--seeds", "2:4", "--json")
    assert [one["seed"] for one in json.loads(several.stdout)] == [2, 3]
    copied = json.loads(fgloc("convert", tmp_path / "one", tmp_path / "copy", "--json").stdout)
    assert copied["log"] == "office-0"
    assert sorted(path.name for path in (tmp_path / "copy").iterdir()) == copied["files"]


@pytest.mark.parametrize(
    ("raised", "code", "said"),
    [
        (InputError("hall.toml: rate is -1"), 2, "error: hall.toml: rate is -1\n"),
        (RunFailedError("the estimate is not finite"), 1, "error: the estimate is not finite\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (ZeroDivisionError("of ours"), 70, "ZeroDivisionError: of ours\n"),
    ],
)
@pytest.mark.parametrize("debug", [False, True])
def test_exit_codes(raised, code, said, debug, monkeypatch, capsys):
    def describe(_):
        raise raised

    monkeypatch.setattr("factorgraph_loc.io.readers.describe", describe)
    monkeypatch.setattr("sys.argv", ["fgloc", "datasets", *(["--debug"] if debug else [])])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == code
    printed = capsys.readouterr()
    assert printed.out == ""
    if debug and code in (1, 2):
        assert printed.err.endswith(f"{type(raised).__name__}: {raised}\n")
    else:
        assert printed.err.endswith(said)
    assert ("Traceback" in printed.err) == (code == 70 or (debug and code != 130))


@pytest.mark.parametrize(
    ("args", "fragments"),
    [
        (["-e", "efk"], ["'efk'", "did you mean ekf?"]),
        (["-e", "ekf", "--set", "ekf.max_dely=1"], ["max_dely", "did you mean max_delay?"]),
        (["-e", "ekf", "--set", "ekf.max_delay=soon"], ["max_delay", "'soon'", "number"]),
        (["-e", "ekf", "--set", "smother.lag=1"], ["'smother'", "did you mean smoother?"]),
        (["-e", "ekf", "--set", "smoother.lag=1"], ["smoother.lag=1", "smoother is not run here"]),
        (["-e", "ekf", "--set", "lag=1"], ["lag=1", "NAME.key=value"]),
        (["-e", "ekf", "--set", "ekf.max_delay"], ["--set", "KEY=VALUE"]),
        (["-e", "ekf", "--prior", "1"], ["'1'", "X,Y or X,Y,HEADING"]),
        (["-e", "dead_reckoning", "--prior", "1,2"], ["dead_reckoning cannot find an unknown heading", "X,Y,HEADING"]),
        (["-e", "ekf", "--sensors", "odometri"], ["odometri", "odometry"]),
        (["-e", "ekf", "--rig", "nowhere.rig.toml"], ["nowhere.rig.toml"]),
        (["-e", "ekf", "--world", "nowhere.world.toml"], ["nowhere.world.toml"]),
        (["-e", "ekf", "--reader", "mrclam", "--reader-option", "robt=1"], ["robt", "did you mean robot?"]),
    ],
)
def test_options_of_run(refused, short_log, tmp_path, args, fragments):
    said = refused("run", short_log, "-o", tmp_path / "out", *args)
    assert all(fragment in said for fragment in fragments)
    assert not (tmp_path / "out").exists()


def test_a_log_that_does_not_exist(refused):
    said = refused("info", "plaza3")
    assert "plaza3" in said
    assert "plaza2" in said


def test_typers_own_usage_errors_have_exit_code_2(fgloc, short_log):
    assert fgloc("run", short_log).exit_code == 2
    assert "Did you mean" in fgloc("inof").stderr
    assert fgloc("run", short_log, "-e", "ekf", "-o", "x", "--seed", "many").exit_code == 2


def test_debug_shows_the_error_itself(fgloc):
    assert isinstance(fgloc("info", "plaza3", "--debug").exception, FglocError)
    assert isinstance(fgloc("--debug", "info", "plaza3").exception, FglocError)


def test_texts_of_options():
    assert parse_seeds("0:10") == range(10)
    assert list(parse_seeds("7")) == [7]
    for text in ("", "a", "3:1", "-2", "1:2:3"):
        with pytest.raises(InputError, match="--seeds"):
            parse_seeds(text)
    texts = ["smoother.lag=10", "smoother.loss=cauchy", "ekf.smooth=false", "smoother.gate.scale=1e-3"]
    assert parse_settings(texts, ["smoother", "ekf"]) == {
        "smoother": {"lag": 10, "loss": "cauchy", "gate": {"scale": 1e-3}},
        "ekf": {"smooth": False},
    }
    with pytest.raises(InputError, match=r"no key smoother.lag.x, because smoother.lag is 10, not a table"):
        parse_settings(["smoother.lag=10", "smoother.lag.x=1"], ["smoother"])


def test_one_of_several_sensors_has_its_name(fgloc, refused, short_log, tmp_path):
    folder = tmp_path / "named"
    shutil.copytree(short_log, folder)
    (folder / "bearing_range.csv").rename(folder / "bearing_range.radio.csv")
    (rig,) = folder.glob("*.rig.toml")
    rig.write_text(
        rig.read_text()
        .replace("[bearing_range", "[bearing_range.radio")
        .replace('"bearing_range"', '"bearing_range.radio"')
    )
    assert "bearing_range.radio" in fgloc("info", folder).stdout
    for sensors in ("odometry,bearing_range", "odometry,bearing_range.radio"):
        done = fgloc("run", folder, "-e", "ekf", "--sensors", sensors, "-o", tmp_path / sensors)
        assert done.exit_code == 0, done.stderr
        assert "bearing_range.radio: normalised innovation squared" in done.stdout
    message = refused("run", folder, "-e", "ekf", "--sensors", "odometry,bearing_range.radar", "-o", tmp_path / "out")
    assert "has no sensor 'bearing_range.radar': did you mean bearing_range.radio?" in message


def test_info_draws_a_log(fgloc, refused, short_log, tmp_path):
    picture = tmp_path / "new" / "log.png"
    result = fgloc("info", short_log, "-o", picture)
    assert result.exit_code == 0
    assert result.stdout.endswith(f"wrote {picture}\n")
    assert cv2.imread(str(picture)).shape[1] == 1600
    assert "expected a name that ends in .png" in refused("info", short_log, "-o", tmp_path / "log.pdf")
