"""Odometry and references from mapped columns: velocities, motions, poses or distances of two wheels."""

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, require
from factorgraph_loc.files import checks
from factorgraph_loc.files.cells import Cells
from factorgraph_loc.files.column_mapping import TableFolder, TimedMapping
from factorgraph_loc.files.columns import POSES as POSE_COLUMNS
from factorgraph_loc.io import motions
from factorgraph_loc.io.motions import TURNS, WHEELS
from factorgraph_loc.io.readers.pose_file import read_kitti, read_pose_file
from factorgraph_loc.model.planar import Turned, on_floor, rotations_of
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.odometry.tables import INCREMENTS, VELOCITIES, WAYS
from factorgraph_loc.sensors.odometry.tables import WHEELS as WHEEL_COLUMNS
from factors import se2
from factors.se2 import Array, Integers

QUATERNION = ("qx", "qy", "qz", "qw")
POSES = (("t", "x", "y", "heading"), ("t", "x", "y", *QUATERNION), ("t", "x", "y", "z", *QUATERNION))
ODOMETRY = (
    ("t", "v", "w"),
    ("t", "dx", "dy", "dtheta"),
    *(("t", left, left.replace("left", "right")) for left in WHEELS),
    *POSES,
)
LEAST_AROUND = 300.0  # rad between rows, which no robot can rotate
COLUMNS = {c.name: c for table in (VELOCITIES, INCREMENTS, WAYS, WHEEL_COLUMNS, POSE_COLUMNS) for c in table.columns}


class PosesFile(TimedMapping, Turned):
    """A file with poses."""

    format: Literal["columns", "tum", "kitti", "euroc"] = "columns"
    """columns by a mapping, a TUM or EuRoC file, or a KITTI file with its times"""
    columns: dict[str, str] = Field(default_factory=dict)
    """column of the file for each field, if the format is columns"""
    times: str | None = None
    """file of the times of a KITTI file"""

    def in_format(self) -> bool:
        """Whether the file is in the format of another program."""
        return self.format != "columns" or self.times is not None


class OdometryFile(PosesFile, motions.WheelSizes):
    """``columns``: t and one of: v, w (speed and turn rate); dx, dy, dtheta (motion since the row before); x, y, heading or a
    quaternion (poses, of which only the relative motion is used); left, right (distances of the wheels), left_speed, right_speed
    (their speeds), left_angle, right_angle (how far they turned), left_rate, right_rate (how fast they turn). ``radius`` and
    ``track`` of the rig ([odometry.wheels]) come before those given here."""


class ReferenceFile(PosesFile):
    """The reference."""

    has_heading: bool = True
    """whether the headings mean anything"""


def read_odometry(folder: TableFolder, options: OdometryFile) -> tuple[Integers, Array]:
    """Timestamps (N,), and velocities (N, 2) or increments (N, 3). InputError names file and row."""
    path, warnings = folder.file(options.file), folder.warnings
    if options.in_format():
        if options.track is not None or options.radius is not None:
            raise InputError(f"{path}: format {options.format} has no wheels, expected no track or radius")
        t_ns, poses = _in_format(folder, options)
        return t_ns, motions.after_rest(motions.between_poses(path, t_ns, poses, warnings))
    mapped = folder.read(options, ODOMETRY)
    side = next((name for name in WHEELS if name in mapped.columns), None)
    if side is None and (options.track is not None or options.radius is not None):
        raise InputError(f"{path}: track and radius are for columns of wheels, such as left and right")
    size, track = options.sizes(path, side, turns=side in TURNS) if side else (1.0, 0.0)
    t_ns, columns = _columns(mapped, options.clock_offset)
    if "dx" in columns:
        moves = np.column_stack((columns["dx"], columns["dy"], columns["dtheta"]))
        return checks.increments_in_order(path, mapped.rows, t_ns, moves, warnings)
    keep = checks.in_order(path, mapped.rows, t_ns, warnings)
    t_ns = t_ns[keep]
    kept = {name: values[keep] for name, values in columns.items()}
    if "v" in kept:
        return t_ns, np.column_stack((kept["v"], kept["w"]))
    if side is not None:
        pair = (side, side.replace("left", "right"))
        wheels = size * np.column_stack([kept[name] for name in pair])
        if side in ("left_speed", "left_rate"):
            return t_ns, motions.velocities_of_wheels(wheels, track)
        scales = size * np.array([COLUMNS[name].in_unit(options.units.get(name, 1.0))[1] for name in pair])
        moves = motions.between_wheels(path, t_ns, wheels, scales, track, warnings)
    else:
        poses = _planar(path, mapped.rows[keep], kept, options, warnings)
        moves = motions.between_poses(path, t_ns, poses, warnings)
    return t_ns, motions.after_rest(moves)


def read_reference(folder: TableFolder, options: ReferenceFile, t0_ns: int) -> Trajectory:
    """The reference in seconds after ``t0_ns``; InputError names file and row of an invalid value."""
    path, warnings = folder.file(options.file), folder.warnings
    if options.in_format():
        t_ns, poses = _in_format(folder, options)
        return Trajectory(checks.seconds(t_ns, t0_ns), poses, has_heading=options.has_heading)
    mapped = folder.read(options, (*POSES, ("t", "x", "y")))
    if "heading" not in mapped.columns and "qw" not in mapped.columns and options.has_heading:
        raise InputError(f"{path}: columns maps no heading: set has_heading = false if there is none")
    t_ns, columns = _columns(mapped, options.clock_offset)
    poses = _planar(path, mapped.rows, columns, options, warnings)
    keep = checks.in_order(path, mapped.rows, t_ns, warnings)
    return Trajectory(checks.seconds(t_ns[keep], t0_ns), poses[keep], has_heading=options.has_heading)


def _in_format(folder: TableFolder, options: PosesFile) -> tuple[Integers, Array]:
    """Timestamps (N,) and planar poses (N, 3) of a file in the format of another program."""
    path = folder.file(options.file)
    if options.columns or options.units:
        raise InputError(f"{path}: format {options.format} has no columns or units to map")
    if (options.format == "kitti") != (options.times is not None):
        raise InputError(f"{path}: format kitti and times, the file of the stamps, are needed together")
    turned: Turned = options
    if options.times is not None:
        found = read_kitti(path, folder.file(options.times))
        if not options.axes:
            turned = Turned(axes="body", mounting=options.mounting)  # the format defines the axes
    else:
        found = read_pose_file(path, "euroc" if options.format == "euroc" else "tum")
    folder.warnings += found.warnings
    assert found.t_ns is not None
    return found.t_ns + round(options.clock_offset * 1e9), found.on_floor(folder.warnings, turned)


def _columns(mapped: Cells, offset: float) -> tuple[Integers, dict[str, Array]]:
    return mapped.stamps("t", offset), {n: mapped.numbers(n, COLUMNS[n]) for n in mapped.columns if n != "t"}


def _planar(path: Path, rows: Integers, columns: dict[str, Array], turned: Turned, warnings: list[str]) -> Array:
    if "qw" in columns:
        rotations = rotations_of(path, rows, np.column_stack([columns[name] for name in QUATERNION]))
        places = np.column_stack((columns["x"], columns["y"], columns.get("z", np.zeros(len(rows)))))
        return on_floor(path, places, rotations, warnings, turned)
    if turned.is_given():
        raise InputError(f"{path}: axes and mounting apply to poses with a quaternion, expected columns qx, qy, qz, qw")
    heading = columns.get("heading", np.zeros(len(rows)))
    around = np.abs(np.diff(heading, prepend=heading[0]))
    valid = ~((around > LEAST_AROUND) & (around < 360.0))
    require(valid, path, rows, "heading", heading, 'radians; it seems to wrap at 360: units.heading = "deg"')
    return np.column_stack((columns["x"], columns["y"], se2.wrap(heading)))
