"""Reads and writes rigs (descriptions of robots and their sensors) as files ``NAME.rig.toml``.

Also makes the default rig of a log without one, and the first rig of a new robot.
"""

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import parse_model, read_toml, write_toml
from factorgraph_loc.files.settings import Setting, settings_in
from factorgraph_loc.io.native.kalibr import read_camera
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.sections import kind_of, several
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factors import se2

# the rig of logs in formats that do not describe the robot
DEFAULT_RIG = Rig(
    name="default",
    bearing_range=BearingRangeSettings(range_sigma=0.2, range_sigma_relative=0.1, bearing_sigma=0.05),
)
_BARE = re.compile(r"[A-Za-z0-9_-]+")
Drive = Literal["differential", "omnidirectional", "none"]
RADIUS, HEIGHT = 0.25, 1.0  # m: distance of antennas from the robot's centre, height of antennas and camera
FIELD_OF_VIEW = math.radians(60.0)
# RFID settings of antennas that are not calibrated: the information of reads is divided by five
READS = {
    "tempering": 0.2,
    "models": {"default": {"kind": "beam", "behind": 0.05, "prior": {"range_scale": 0.3, "read_rate": 1.0}}},
    "uncertainty": {"yaw": 0.02, "antenna_yaw": 0.015, "time_offset": 0.02},
}
# standard deviations of the constants of wheels that are not calibrated
UNCALIBRATED = {"scale_distance": 0.03, "scale_rotation": 0.05, "heading_drift": 0.03}


def default_rig(streams: Iterable[str]) -> Rig:
    """Return default settings of the robot and its sensors. ``streams``: names of the sensors, such as "odometry"."""
    named = [name for name in streams if kind_of(name) != name and DEFAULT_RIG.section(kind_of(name)) is not None]
    if not named:
        return DEFAULT_RIG
    without = DEFAULT_RIG.model_copy(update={kind_of(name): None for name in named})
    rig = without.model_copy(update={name: DEFAULT_RIG.section(kind_of(name)) for name in named})
    return rig.model_copy(update={"sensors": rig.expanded(rig.sensors)})


def read_rig(path: str | Path) -> Rig:
    """Return the rig, the settings of a robot and its sensors, in ``NAME.rig.toml`` and the files that it names.

    Raises InputError with the file, the key and the expected value.
    """
    path = Path(path)
    return parse_model(Rig, read_toml(path), path).placed(path.parent)


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig, the settings of a robot and its sensors, to ``path``, which should be named ``NAME.rig.toml``.

    The grids of RFID detection models are written as tables to the same folder.
    """
    path = Path(path)
    rig.write_beside(path.parent)
    write_toml(path, rig.model_dump(mode="json", exclude_none=True))


def rig_text(rig: Rig, remarks: Sequence[str] = ()) -> str:
    """Return the text of a file ``NAME.rig.toml``, with the meaning and the unit of each key as a comment.

    ``remarks``: comments at the beginning of the file.
    """
    meanings = {setting.key: setting for setting in settings_in(Rig)}
    lines = [f"# {remark}" for remark in remarks]
    lines += _lines(rig.model_dump(mode="json", exclude_none=True), (), (), meanings)
    return "\n".join(lines).lstrip("\n") + "\n"


def _lines(
    table: Mapping[str, Any], path: tuple[str, ...], pattern: tuple[str, ...], meanings: Mapping[str, Setting]
) -> Iterator[str]:
    """Yield the lines of a table of settings and of the tables below it.

    ``path``: the keys that lead to the table. ``pattern``: the same keys, with ``*`` for names that the user chooses.
    ``meanings``: the documentation of each setting by its pattern."""
    tables = {key: value for key, value in table.items() if isinstance(value, Mapping)}
    own = {key: value for key, value in table.items() if key not in tables}
    if path and (own or not tables):
        yield from ("", f"[{'.'.join(map(_key, path))}]{_comment(meanings.get('.'.join(pattern)))}")
    for key, value in own.items():
        comment = _comment(meanings.get(".".join((*pattern, key))))
        yield f"{_key(key)} = {json.dumps(value, ensure_ascii=False)}{comment}"
    for key, value in tables.items():
        known = any(name.startswith(".".join((*pattern, key))) for name in meanings)
        below = (*pattern, key if known else "*")
        if not known and ".".join(path) in several():  # the key is the name of one of several sensors of a kind
            below = pattern
        yield from _lines(value, (*path, key), below, meanings)


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else json.dumps(name, ensure_ascii=False)


def _comment(setting: Setting | None) -> str:
    if setting is None or not setting.meaning:
        return ""
    return f"  # {setting.meaning}" + (f" [{setting.unit}]" if setting.unit else "")


@dataclass(frozen=True)
class RobotOptions:
    """The sensors of a new robot, for :func:`new_rig`. None means that the robot lacks a sensor.

    ``odometry``: the type of drive, "none" for a robot without odometry.
    ``imu``: True if the robot has a gyro.
    ``landmarks``: standard deviation of a measured range [m], or a dict of them by name of the sensor.
    ``position``: standard deviation of a measured x or y [m].
    ``antennas``: names of RFID antennas.
    ``camera``: width and height of the images [px], or a camera chain of Kalibr, as ``FILE`` or ``FILE:NAME``.
    """

    odometry: Drive = "differential"
    imu: bool = False
    landmarks: float | Mapping[str, float] | None = None
    antennas: tuple[str, ...] = ()
    camera: tuple[int, int] | str | None = None
    position: float | None = None


def new_rig(name: str, robot: RobotOptions) -> tuple[Rig, list[str]]:
    """Return a rig called ``name``, the settings of a robot and its sensors, and remarks about the guessed values.

    ``robot``: its sensors. Raises InputError if a value is out of bounds, or if there is no sensor.
    """
    sections: dict[str, Any] = {}
    remarks: list[str] = []
    if robot.odometry != "none":
        remarks.append(
            "odometry: noise and uncertainty are typical values of indoor robots; `fgloc calibrate` estimates them"
        )
        sections["odometry"] = {"uncertainty": UNCALIBRATED}
    if robot.odometry == "omnidirectional":
        sections["odometry"]["noise"] = {"lateral": Rig().odometry.noise.along.model_dump()}
    if robot.imu:
        sections["imu"] = {}
    if isinstance(robot.landmarks, Mapping):
        sections |= {f"bearing_range.{name}": {"range_sigma": sigma} for name, sigma in robot.landmarks.items()}
    elif robot.landmarks is not None:
        sections["bearing_range"] = {"range_sigma": robot.landmarks}
    if robot.position is not None:
        sections["position"] = {"sigma": robot.position}
    remarks += [
        f"{name}: the sensor is assumed at the robot's centre: measure its x and y, and set them"
        for name in sections
        if kind_of(name) in ("bearing_range", "position")
    ]
    if robot.antennas:
        sections["rfid"] = {"antennas": _antennas(robot.antennas), **READS}
        remarks.append(
            "rfid: the positions and directions of the antennas are guesses: measure them; `fgloc calibrate` estimates the "
            "detection model"
        )
    if isinstance(robot.camera, str):
        sections["camera"], notes = read_camera(robot.camera)
        remarks += notes
    elif robot.camera is not None:
        sections["camera"] = _camera(*robot.camera)
        remarks.append(
            "camera: the lens (60 degrees wide) and the mounting (facing forward) are guesses; calibrate the lens with OpenCV"
        )
    if not sections:
        raise InputError("the new rig has no sensors, expected odometry, landmarks, positions, antennas or a camera")
    return parse_model(Rig, {"name": name, "sensors": list(sections), **_nested(sections)}, "the new rig"), remarks


def _nested(sections: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sections of a rig nested as in its file: ``{"a": {"b": ...}}`` instead of ``{"a.b": ...}``."""
    out: dict[str, Any] = {}
    for key, section in sections.items():
        kind, _, name = key.partition(".")
        out |= {kind: {**out.get(kind, {}), name: section} if name else section}
    return out


def _antennas(names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the settings of antennas ``names``, evenly spaced around the robot, counter-clockwise from the front.

    Two antennas face to the left and to the right."""
    first = math.pi / 2.0 if len(names) == 2 else 0.0
    directions = [se2.wrap_scalar(first + 2.0 * math.pi * i / len(names)) for i in range(len(names))]
    return {
        name: {
            "x": round(RADIUS * math.cos(yaw), 4),
            "y": round(RADIUS * math.sin(yaw), 4),
            "z": HEIGHT,
            "yaw": yaw,
        }
        for name, yaw in zip(names, directions, strict=True)
    }


def _camera(width: int, height: int) -> dict[str, float]:
    focal = round(width / 2.0 / math.tan(FIELD_OF_VIEW / 2.0), 1)
    centre = {"cx": (width - 1) / 2.0, "cy": (height - 1) / 2.0}
    return {"width": width, "height": height, "fx": focal, "fy": focal, **centre, "z": HEIGHT}
