"""The command ``fgloc rigs``, which lists the known rigs, prints a rig, and writes a new rig for a robot."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from factorgraph_loc.cli import completion, show
from factorgraph_loc.cli.options import Json, Overwrite
from factorgraph_loc.errors import InputError
from factorgraph_loc.text import quoted

T = TypeVar("T")
MOST_ANTENNAS = 64
DRIVES: dict[str, Any] = {name: name for name in ("differential", "omnidirectional", "none")}
YES = {"yes": True, "no": False}
app = typer.Typer(rich_markup_mode=None)


@app.callback(invoke_without_command=True)
def rigs(context: typer.Context, json: Json = False) -> None:
    """List the known rigs, print a rig, or write a new rig.

    Example: fgloc rigs
    """
    if context.invoked_subcommand is not None:
        return
    from factorgraph_loc.api.lookups import sources_of_rigs

    known = [(name, source, make()) for name, (source, make) in sources_of_rigs().items()]
    if json:
        show.document([{"name": name, "of": source, "sensors": rig.sensors} for name, source, rig in known])
    else:
        show.table(("name", "of", "sensors"), [(name, source, ", ".join(rig.sensors)) for name, source, rig in known])


@app.command("show")
def show_(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="A name of the list, or a rig file.", autocompletion=completion.rig)
    ],
    json: Json = False,
) -> None:
    """Print a rig as TOML, with a comment on each key.

    Example: fgloc rigs show plaza
    """
    from factorgraph_loc.api.lookups import sources_of_rigs
    from factorgraph_loc.files.models import nearest
    from factorgraph_loc.io.native.rig_file import read_rig, rig_text

    known = sources_of_rigs()
    if name not in known and not name.endswith(".toml"):
        raise InputError(f"no rig is called {quoted(name)}{nearest(name, list(known))}")
    rig = known[name][1]() if name in known else read_rig(name)
    if json:
        show.document(rig.model_dump(mode="json", exclude_none=True))
    else:
        show.lines(rig_text(rig).rstrip("\n"))


@app.command()
def new(
    odometry: Annotated[str | None, typer.Option(metavar="DRIVE", help=f"{', '.join(DRIVES)}.")] = None,
    imu: Annotated[bool | None, typer.Option("--imu/--no-imu", help="Whether there is a gyro.")] = None,
    landmarks: Annotated[
        str | None,
        typer.Option(
            metavar="METRES|A=M,B=M",
            help="Standard deviation of ranges to landmarks, for each of several radios, or none.",
        ),
    ] = None,
    antennas: Annotated[
        str | None, typer.Option(metavar="NUMBER|A,B", help="RFID antennas around the body: how many, or their names.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="WxH|FILE", help="Image size, 640x480; or a camera chain of Kalibr, FILE.yaml[:CAMERA]; or none."
        ),
    ] = None,
    position: Annotated[
        str | None, typer.Option(metavar="METRES", help="Standard deviation of measured positions, or none.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", metavar="FILE", help="The rig to write.")] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Write a rig with comments for a robot with the given sensors. At a terminal, the command asks for missing options.

    Example: fgloc rigs new --antennas left,right -o cart.rig.toml
    """
    from factorgraph_loc.api.lookups import write_new_rig
    from factorgraph_loc.io.native.rig_file import RobotOptions, new_rig

    asks = not json and sys.stdin.isatty() and sys.stderr.isatty()
    robot = RobotOptions(
        _value("--odometry", odometry, "differential", f"one of {', '.join(DRIVES)}", DRIVES.__getitem__, asks),
        _value("--imu", None if imu is None else "yes" if imu else "no", "no", "yes or no", YES.__getitem__, asks),
        _value("--landmarks", landmarks, "none", "the noise of a range in m, A=M,B=M, or none", _ranges, asks),
        _value("--antennas", antennas, "0", f"a number from 0 to {MOST_ANTENNAS}, or names", _antennas, asks),
        _value("--camera", camera, "none", "a size such as 640x480, a file of Kalibr, or none", _size, asks),
        _value("--position", position, "none", "the noise of a position in m, or none", _metres, asks),
    )
    given, name = None if out is None else str(out), "robot.rig.toml" if asks else ""
    file = _value("--out", given, name, "the file to write, such as robot.rig.toml", _file, asks)
    rig, remarks = new_rig(file.name.removesuffix(".toml").removesuffix(".rig"), robot)
    write_new_rig(rig, remarks, file, overwrite=overwrite)
    if json:
        show.document({"file": str(file), "rig": rig.model_dump(mode="json", exclude_none=True), "remarks": remarks})
        return
    for remark in remarks:
        show.line(remark)
    show.line(f"wrote {file}; use it with --rig {file}, or name it as rig in run.toml of a log")


def _value(option: str, given: str | None, default: str, expected: str, parse: Callable[[str], T], asks: bool) -> T:
    """Return the value of ``option``, parsed by ``parse``, which raises KeyError or ValueError for an invalid text.

    ``given``: the text on the command line, None if the option is missing. If it is missing and ``asks`` is True, the
    user is asked until the answer is valid. ``default``: the text to use without an answer. ``expected``: describes
    valid texts. Raises InputError if ``given`` is invalid."""
    while True:
        text = default if given is None else given
        if given is None and asks:
            print(f"{option.removeprefix('--')}: {expected} [{default}]: ", end="", file=sys.stderr, flush=True)
            text = sys.stdin.readline().strip() or default
        try:
            return parse(text)
        except (KeyError, ValueError) as error:
            wrong = f"{option} is {quoted(text) if text else 'missing'}, expected {expected}"
            if given is not None or not asks:
                raise InputError(wrong) from error
            show.note(wrong)


def _antennas(text: str) -> tuple[str, ...]:
    names = tuple(map(str, range(1, int(text) + 1))) if text.isdecimal() else tuple(text.split(","))
    if not all(names) or len(set(names)) < len(names) or len(names) > MOST_ANTENNAS:
        raise ValueError
    return names


def _metres(text: str) -> float | None:
    return None if text == "none" else float(text)


def _ranges(text: str) -> float | dict[str, float] | None:
    if "=" not in text:
        return _metres(text)
    pairs = [part.split("=") for part in text.split(",")]
    sigmas = {name: float(sigma) for name, sigma in pairs}
    if not all(sigmas) or len(sigmas) < len(pairs):
        raise ValueError
    return sigmas


def _size(text: str) -> tuple[int, int] | str | None:
    from factorgraph_loc.io.native.kalibr import is_chain

    if text == "none":
        return None
    if is_chain(text):
        return text
    if not (size := re.fullmatch("([0-9]{1,6})x([0-9]{1,6})", text)):
        raise ValueError
    return int(size[1]), int(size[2])


def _file(text: str) -> Path:
    if not text.endswith(".toml"):
        raise ValueError
    return Path(text)
