"""``fgloc rigs``: the rigs that there are, and a first one for a robot."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import typer

from factorgraph_loc.cli import completion, show
from factorgraph_loc.cli.options import Json, Overwrite
from factorgraph_loc.errors import InputError
from factorgraph_loc.text import quoted

T = TypeVar("T")
MOST_ANTENNAS = 64
DRIVES = ("differential", "omnidirectional", "none")
app = typer.Typer(rich_markup_mode=None)


@app.callback(invoke_without_command=True)
def rigs(context: typer.Context, json: Json = False) -> None:
    """List the rigs that there are; print one; write a new one."""
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
        str, typer.Argument(metavar="NAME", help="One of the list, or a rig's file.", autocompletion=completion.rig)
    ],
    json: Json = False,
) -> None:
    """Print a rig as TOML, each key with its meaning."""
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
    imu: Annotated[bool | None, typer.Option("--imu/--no-imu", help="A gyro.")] = None,
    landmarks: Annotated[
        str | None, typer.Option(metavar="METRES", help="Standard deviation of ranges to landmarks, or none.")
    ] = None,
    antennas: Annotated[str | None, typer.Option(metavar="NUMBER", help="RFID antennas, around the body.")] = None,
    camera: Annotated[str | None, typer.Option(metavar="WxH", help="Size of its images, 640x480, or none.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", metavar="FILE", help="The rig to write.")] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Write the rig of a robot with some sensors, with comments. At a terminal, options that are not given are asked for."""
    from factorgraph_loc.api.lookups import write_new_rig
    from factorgraph_loc.io.native.rig_file import RobotOptions, new_rig

    asks = not json and sys.stdin.isatty() and sys.stderr.isatty()
    robot = RobotOptions(
        _value("--odometry", odometry, "differential", _drive, asks and f"odometry: {', '.join(DRIVES)}"),
        _value("--imu", None if imu is None else "yes" if imu else "no", "no", _yes, asks and "gyro: yes, no"),
        _value("--landmarks", landmarks, "none", _metres, asks and "landmarks: noise of a range in m, or none"),
        _value("--antennas", antennas, "0", _count, asks and "RFID antennas: how many"),
        _value("--camera", camera, "none", _size, asks and "camera: size of its images, such as 640x480, or none"),
    )
    file = _value("--out", None if out is None else str(out), "robot.rig.toml" if asks else "", _file, asks and "file")
    rig, remarks = new_rig(file.name.removesuffix(".toml").removesuffix(".rig"), robot)
    write_new_rig(rig, remarks, file, overwrite=overwrite)
    if json:
        show.document({"file": str(file), "rig": rig.model_dump(mode="json", exclude_none=True), "remarks": remarks})
        return
    for remark in remarks:
        show.line(remark)
    show.line(f"wrote {file}; use it by --rig {file}, or name it in run.toml of a log")


def _value(
    option: str, given: str | None, default: str, parse: Callable[[str, str], T], question: str | Literal[False]
) -> T:
    """The value of an option: what is given, else the answer to a question, if there is one, else the default."""
    if given is not None or not question:
        return parse(option, default if given is None else given)
    while True:
        print(f"{question} [{default}]: ", end="", file=sys.stderr, flush=True)
        try:
            return parse(option, sys.stdin.readline().strip() or default)
        except InputError as error:
            show.note(str(error))


def _drive(option: str, text: str) -> Any:
    if text not in DRIVES:
        raise InputError(f"{option} is {quoted(text)}, expected one of {', '.join(DRIVES)}")
    return text


def _yes(option: str, text: str) -> bool:
    if text not in ("yes", "no"):
        raise InputError(f"{option} is {quoted(text)}, expected yes or no")
    return text == "yes"


def _metres(option: str, text: str) -> float | None:
    try:
        return None if text == "none" else float(text)
    except ValueError as error:
        raise InputError(f"{option} is {quoted(text)}, expected the noise of a range in m, or none") from error


def _count(option: str, text: str) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 3 or int(text) > MOST_ANTENNAS:
        raise InputError(f"{option} is {quoted(text)}, expected a whole number from 0 to {MOST_ANTENNAS}")
    return int(text)


def _size(option: str, text: str) -> tuple[int, int] | None:
    if text == "none":
        return None
    sides = text.split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() and len(side) <= 6 for side in sides):
        raise InputError(f"{option} is {quoted(text)}, expected a size such as 640x480, or none")
    return int(sides[0]), int(sides[1])


def _file(option: str, text: str) -> Path:
    if not text.endswith(".toml"):
        given = quoted(text) if text else "missing"
        raise InputError(f"{option} is {given}, expected the file to write, such as robot.rig.toml")
    return Path(text)
