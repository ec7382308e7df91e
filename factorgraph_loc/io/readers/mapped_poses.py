"""Odometry and references from mapped columns: velocities, motions, poses or distances of two wheels."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.column_mapping import ColumnMapping, Mapped, Unread, read_mapped
from factorgraph_loc.files.columns import POSES as POSE_COLUMNS
from factorgraph_loc.files.models import InUnit
from factorgraph_loc.io import motions
from factorgraph_loc.io.readers.pose_file import EUROC, read_kitti, read_poses
from factorgraph_loc.model.planar import Turned, on_floor, rotations_of
from factorgraph_loc.model.trajectory import Trajectory, read_tum_rows
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream
from factorgraph_loc.sensors.odometry.tables import INCREMENTS, VELOCITIES, WAYS
from factorgraph_loc.sensors.odometry.tables import WHEELS as WHEEL_COLUMNS
from factors import se2
from factors.se2 import Array, Integers

Offset = Annotated[float, Field(ge=-1e10, le=1e10), InUnit("s")]

QUATERNION = ("qx", "qy", "qz", "qw")
POSES = (("t", "x", "y", "heading"), ("t", "x", "y", *QUATERNION), ("t", "x", "y", "z", *QUATERNION))
TURNS = {"left_angle": "rad", "left_rate": "rad/s"}  # of wheels, which need their radius
WHEELS = ("left", "left_speed", *TURNS)
ODOMETRY = (
    ("t", "v", "w"),
    ("t", "dx", "dy", "dtheta"),
    *(("t", left, left.replace("left", "right")) for left in WHEELS),
    *POSES,
)
LEAST_AROUND = 300.0  # rad between rows, which no robot can rotate
COLUMNS = {c.name: c for table in (VELOCITIES, INCREMENTS, WAYS, WHEEL_COLUMNS, POSE_COLUMNS) for c in table.columns}


class PosesFile(ColumnMapping, Turned):
    """A file with poses."""

    format: Literal["columns", "tum", "kitti", "euroc"] = "columns"
    """columns by a mapping, a TUM or EuRoC file, or a KITTI file with its times"""
    columns: dict[str, str] = Field(default_factory=dict)
    """column of the file for each field, if the format is columns"""
    times: str | None = None
    """file of the times of a KITTI file"""
    clock_offset: Offset = 0.0
    """added to all timestamps"""


class OdometryFile(PosesFile):
    """``columns``: t and one of: v, w (speed and turn rate); dx, dy, dtheta (motion since the row before); x, y, heading or a
    quaternion (poses, of which only the relative motion is used); left, right (distances of the wheels), left_speed, right_speed
    (their speeds), left_angle, right_angle (how far they turned), left_rate, right_rate (how fast they turn). ``radius`` and
    ``track`` of the rig ([odometry.wheels]) come before those given here."""

    track: Annotated[float, Field(gt=0.0, le=20.0), InUnit("m")] | None = None
    """distance between the wheels, for columns of wheels"""
    radius: Annotated[float, Field(gt=0.0, le=5.0), InUnit("m")] | None = None
    """radius of the wheels, for columns that tell how they turn"""


class ReferenceFile(PosesFile):
    """The reference."""

    has_heading: bool = True
    """whether the headings mean anything"""


def read_odometry(
    path: Path, times: Path | None, options: OdometryFile, warnings: list[str], unread: Unread
) -> tuple[Integers, Array, bool]:
    """Timestamps (N,), velocities (N, 2) or increments (N, 3), and whether these are increments. InputError names file and row."""
    if options.format != "columns" or times is not None:
        if options.track is not None or options.radius is not None:
            raise InputError(f"{path}: format {options.format} has no wheels, expected no track or radius")
        t_ns, poses = _in_format(path, times, options, warnings)
        return t_ns, after_rest(motions.between_poses(path, t_ns, poses, warnings)), True
    mapped = read_mapped(path, options, ODOMETRY)
    unread.note(mapped)
    side = next((name for name in WHEELS if name in mapped.fields), None)
    _require_sizes(path, side, options)
    t_ns, columns = _columns(mapped, options.clock_offset)
    if "dx" in columns:
        moves = np.column_stack((columns["dx"], columns["dy"], columns["dtheta"]))
        return *checks.increments_in_order(path, mapped.rows, t_ns, moves, warnings), True
    keep = checks.in_order(path, mapped.rows, t_ns, warnings)
    t_ns = t_ns[keep]
    kept = {name: values[keep] for name, values in columns.items()}
    if "v" in kept:
        return t_ns, np.column_stack((kept["v"], kept["w"])), False
    if side is not None and options.track is not None:
        pair = (side, side.replace("left", "right"))
        size = options.radius if side in TURNS and options.radius is not None else 1.0
        wheels = size * np.column_stack([kept[name] for name in pair])
        if side in ("left_speed", "left_rate"):
            return t_ns, motions.velocities_of_wheels(wheels, options.track), False
        scales = size * np.array([_scale(options, name) for name in pair])
        return t_ns, after_rest(motions.between_wheels(path, t_ns, wheels, scales, options.track, warnings)), True
    poses = _planar(path, mapped.rows[keep], kept, options, warnings)
    return t_ns, after_rest(motions.between_poses(path, t_ns, poses, warnings)), True


def _require_sizes(path: Path, side: str | None, options: OdometryFile) -> None:
    """InputError if the size of wheels is missing, or is given without columns of wheels."""
    if side is None and (options.track is not None or options.radius is not None):
        raise InputError(f"{path}: track and radius are for columns of wheels, such as left and right")
    needed = {"track": side is not None, "radius": side in TURNS}
    for name, is_needed in needed.items():
        if is_needed and getattr(options, name) is None:
            raise InputError(f"{path}: {side} needs {name} [m], here or in [odometry.wheels] of the rig")


def odometry_stream(t_ns: Integers, values: Array, increments: bool, t0_ns: int) -> IncrementStream | VelocityStream:
    t = checks.seconds(t_ns, t0_ns)
    return IncrementStream(t, *values.T) if increments else VelocityStream(t, *values.T)


def read_reference(
    path: Path, times: Path | None, options: ReferenceFile, t0_ns: int, warnings: list[str], unread: Unread
) -> Trajectory:
    """The reference in seconds after ``t0_ns``; InputError names file and row of an invalid value."""
    if options.format != "columns" or times is not None:
        t_ns, poses = _in_format(path, times, options, warnings)
        return Trajectory(checks.seconds(t_ns, t0_ns), poses, has_heading=options.has_heading)
    mapped = read_mapped(path, options, (*POSES, ("t", "x", "y")))
    unread.note(mapped)
    if "heading" not in mapped.fields and "qw" not in mapped.fields and options.has_heading:
        raise InputError(f"{path}: columns maps no heading: set has_heading = false if there is none")
    t_ns, columns = _columns(mapped, options.clock_offset)
    poses = _planar(path, mapped.rows, columns, options, warnings)
    keep = checks.in_order(path, mapped.rows, t_ns, warnings)
    return Trajectory(checks.seconds(t_ns[keep], t0_ns), poses[keep], has_heading=options.has_heading)


def _in_format(path: Path, times: Path | None, options: PosesFile, warnings: list[str]) -> tuple[Integers, Array]:
    """Timestamps (N,) and planar poses (N, 3) of a file in the format of another program."""
    if options.columns or options.units:
        raise InputError(f"{path}: format {options.format} has no columns or units to map")
    if (options.format == "kitti") != (times is not None):
        raise InputError(f"{path}: format kitti and times, the file of the stamps, are needed together")
    turned: Turned = options
    if times is not None:
        rows, t_ns, space = read_kitti(path, times)
        positions, rotations = space.positions, space.rotations
        if not options.axes:
            turned = Turned(axes="body", mounting=options.mounting)  # the format defines the axes
    elif options.format == "euroc":
        t_ns, space = read_poses(path, EUROC, unit="ns", separator=",", warnings=warnings)
        rows, positions, rotations = np.arange(1, len(t_ns) + 1), space.positions, space.rotations
    else:
        rows, t_ns, table = read_tum_rows(path)
        positions, rotations = table[:, :3], rotations_of(path, rows, table[:, 3:])
    poses = on_floor(path, positions, rotations, warnings, turned)
    keep = checks.in_order(path, rows, t_ns, warnings)
    return t_ns[keep] + round(options.clock_offset * 1e9), poses[keep]


def _columns(mapped: Mapped, offset: float) -> tuple[Integers, dict[str, Array]]:
    return mapped.stamps("t", offset), {n: mapped.numbers(n, COLUMNS[n]) for n in mapped.fields if n != "t"}


def _scale(options: OdometryFile, field: str) -> float:
    """Metres or radians per unit of a column, or per tick of an encoder."""
    unit = options.units.get(field, 1.0)
    return COLUMNS[field].units.get(unit, 1.0) if isinstance(unit, str) else float(unit)


def _planar(path: Path, rows: Integers, columns: dict[str, Array], turned: Turned, warnings: list[str]) -> Array:
    if "qw" in columns:
        rotations = rotations_of(path, rows, np.column_stack([columns[name] for name in QUATERNION]))
        places = np.column_stack((columns["x"], columns["y"], columns.get("z", np.zeros(len(rows)))))
        return on_floor(path, places, rotations, warnings, turned)
    if turned.is_given():
        raise InputError(f"{path}: axes and mounting apply to poses with a quaternion, expected columns qx, qy, qz, qw")
    heading = columns.get("heading", np.zeros(len(rows)))
    around = np.abs(np.diff(heading, prepend=heading[0]))
    if degrees := np.flatnonzero((around > LEAST_AROUND) & (around < 360.0)).tolist():
        i = degrees[0]
        expected = 'radians; it seems to wrap at 360: units.heading = "deg"'
        raise bad_field(path, "heading", float(heading[i]), expected, row=int(rows[i]))
    return np.column_stack((columns["x"], columns["y"], se2.wrap(heading)))


def after_rest(moves: Array) -> Array:
    """Motions (N - 1, 3) as increments (N, 3): the first row only defines the start."""
    return np.vstack((np.zeros((1, 3)), moves))
