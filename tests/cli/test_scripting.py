"""What scripts rely on: JSON from every command, and exit codes that say what happened."""

import json
from collections.abc import Iterator

import pytest
from typer.main import get_command

from factorgraph_loc.cli.app import app
from factorgraph_loc.cli.main import main
from factorgraph_loc.errors import InputError, RunFailedError


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
