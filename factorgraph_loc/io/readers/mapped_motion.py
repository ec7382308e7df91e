"""Odometry and the reference in tables of other programs: velocities, increments, wheels or poses."""

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
from factorgraph_loc.model.planar import Turned, are_null, not_unit, null_poses, on_floor, rotations_of
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.odometry.measurement import INCREMENTS, VELOCITIES, WAYS, since_skipped
from factorgraph_loc.sensors.odometry.measurement import WHEELS as WHEEL_COLUMNS
from factorgraph_loc.text import Notice
from factors import se2
from factors.se2 import Array, Integers

QUATERNION = ("qx", "qy", "qz", "qw")
POSES = (("t", "x", "y", "heading"), ("t", "x", "y", *QUATERNION), ("t", "x", "y", "z", *QUATERNION))
ODOMETRY = (
    ("t", "v", "w"),
    ("t", "dx", "dy", "dtheta"),
    *(("t", *wheels) for left in WHEELS for wheels in (motions.wheels_of(left, 2), motions.wheels_of(left, 4))),
    *POSES,
)
LEAST_AROUND = 300.0  # change of heading between rows above which the heading is assumed to wrap at 360, in degrees
COLUMNS = {c.name: c for table in (VELOCITIES, INCREMENTS, WAYS, WHEEL_COLUMNS, POSE_COLUMNS) for c in table.columns}
COLUMNS |= {f"rear_{name}": column for name, column in COLUMNS.items() if name.startswith(("left", "right"))}


class PosesFile(TimedMapping, Turned):
    """The settings of a file with poses: a table with mapped columns, or a file in TUM, KITTI or EuRoC format."""

    format: Literal["columns", "tum", "kitti", "euroc"] = "columns"
    """format of the file: columns for a table with a mapping of columns, or a common format of trajectories"""
    columns: dict[str, str] = Field(default_factory=dict)
    """column of the file for each field, if the format is columns"""
    times: str | None = None
    """file with the timestamps of a KITTI file"""

    def is_in_format(self) -> bool:
        """True if the file is in TUM, KITTI or EuRoC format, not a table with mapped columns."""
        return self.format != "columns" or self.times is not None


class OdometryFile(PosesFile, motions.WheelSizes):
    """The table of odometry. ``columns`` maps t and one of: v, w (speed and turn rate); dx, dy, dtheta (motion since
    the previous row); x, y, and heading or a quaternion (poses; only their relative motion is used); left, right
    (distances of the wheels); left_speed, right_speed (speeds); left_angle, right_angle (angles); left_rate, right_rate
    (angular rates). Four wheels also need rear_left, rear_right (rear_left_speed, ...). ``radius`` and ``track`` of the
    rig ([odometry.wheels]) have precedence over these settings."""


class ReferenceFile(PosesFile):
    """The settings of the file with the reference trajectory."""

    has_heading: bool = True
    """true if the reference measures the heading; false if its headings are meaningless"""


def read_odometry(folder: TableFolder, options: OdometryFile) -> tuple[Integers, Array]:
    """Return the timestamps (N,) [ns] of the odometry, and its velocities (N, 2) or increments (N, 3 or 4).

    A velocity is forward [m/s] and turn rate [rad/s]. An increment is x, y [m] and heading [rad] since the previous
    timestamp. Its optional fourth column is the part [s] of this time without a valid pose. ``options``: describe the
    file in ``folder``. Raises InputError with file and row of an invalid value.
    """
    path, warnings = folder.file(options.file), folder.warnings
    if options.is_in_format():
        if options.has_sizes():
            raise InputError(f"{path}: format {options.format} has no wheels: remove track, radius and base")
        t_ns, poses, lost_ns = _in_format(folder, options)
        return motions.bridge_losses(t_ns, motions.between_poses(path, t_ns, poses, warnings, lost_ns), lost_ns)
    mapped, lost_ns = _with_poses(folder.read(options, ODOMETRY, COLUMNS), options, warnings)
    side = next((name for name in WHEELS if name in mapped.columns), None)
    wheel_names = motions.wheels_of(side, 4 if f"rear_{side}" in mapped.columns else 2) if side else ()
    if side is None and options.has_sizes():
        raise InputError(
            f"{path}: track, radius or base is given, but columns has no wheels, such as left and right: add them, or remove "
            "track, radius and base"
        )
    if options.base is not None and len(wheel_names) == 2:
        raise InputError(f"{path}: base is given, but columns has only two wheels: add rear_{side} too, or remove base")
    size = options.metres(path, side, turns=side in TURNS) if side else 1.0
    t_ns, columns = _columns(mapped, options.clock_offset)
    if "dx" in columns:
        lost = since_skipped(t_ns, mapped.resumed)
        moves = np.column_stack((columns["dx"], columns["dy"], columns["dtheta"], lost))
        return checks.increments_in_order(path, mapped.rows, t_ns, moves, warnings, options)
    keep = checks.in_order(path, mapped.rows, t_ns, warnings, options)
    t_ns = t_ns[keep]
    kept = {name: values[keep] for name, values in columns.items()}
    if "v" in kept:
        return t_ns, np.column_stack((kept["v"], kept["w"]))
    if side is not None:
        wheels = size * np.column_stack([kept[name] for name in wheel_names])
        if side in ("left_speed", "left_rate"):
            return t_ns, motions.motion_of_wheel_speeds(path, t_ns, wheels, options, warnings)
        scales = size * np.array([COLUMNS[name].in_unit(options.units.get(name, 1.0))[1] for name in wheel_names])
        moves = motions.motion_of_wheel_distances(path, t_ns, wheels, scales, options, warnings)
    else:
        poses = _planar(path, mapped.rows[keep], kept, options, warnings)
        moves = motions.between_poses(path, t_ns, poses, warnings, lost_ns)
    return motions.bridge_losses(t_ns, moves, lost_ns)


def read_reference(folder: TableFolder, options: ReferenceFile, t0_ns: int) -> Trajectory:
    """Return the reference trajectory from the file of ``options`` in ``folder``, with times [s] since ``t0_ns`` [ns].

    Raises InputError with the file and the row of an invalid value.
    """
    path, warnings = folder.file(options.file), folder.warnings
    if options.is_in_format():
        t_ns, poses, _ = _in_format(folder, options)
        return Trajectory(checks.seconds(t_ns, t0_ns), poses, has_heading=options.has_heading)
    mapped, _ = _with_poses(folder.read(options, (*POSES, ("t", "x", "y")), COLUMNS), options, warnings)
    if "heading" not in mapped.columns and "qw" not in mapped.columns and options.has_heading:
        raise InputError(
            f"{path}: columns in [options.reference] has neither heading nor qx, qy, qz, qw: add one of them, or set "
            "has_heading = false"
        )
    t_ns, columns = _columns(mapped, options.clock_offset)
    poses = _planar(path, mapped.rows, columns, options, warnings)
    keep = checks.in_order(path, mapped.rows, t_ns, warnings, options)
    return Trajectory(checks.seconds(t_ns[keep], t0_ns), poses[keep], has_heading=options.has_heading)


def _with_poses(mapped: Cells, options: PosesFile, warnings: list[Notice]) -> tuple[Cells, Integers]:
    """Return the rows of ``mapped`` without null poses, and the timestamps (M,) [ns] of the null poses.

    A null pose has a zero quaternion: the device had lost its pose. Raises InputError if another quaternion is not a
    unit quaternion, unless ``options`` skip such rows. If any rows are skipped, a warning is appended to ``warnings``."""
    if "qw" not in mapped.columns:
        return mapped, np.zeros(0, dtype=np.int64)
    null = are_null(np.column_stack([mapped.numbers(name, COLUMNS[name]) for name in QUATERNION]))
    lost_ns = mapped.stamps("t", options.clock_offset)[null]
    if null.any():
        warnings.append(null_poses(mapped.path, int(mapped.rows[null.argmax()]), len(lost_ns)))
        mapped = mapped.rows_at(np.flatnonzero(~null))
    quaternions = np.column_stack([mapped.numbers(name, COLUMNS[name]) for name in QUATERNION])
    return mapped.without([not_unit(quaternions)], warnings), lost_ns


def _in_format(folder: TableFolder, options: PosesFile) -> tuple[Integers, Array, Integers]:
    """Return timestamps (N,) [ns], poses (N, 3) and timestamps of null poses of a TUM, KITTI or EuRoC file.

    A pose is x, y [m] and heading [rad]. A null pose means that the device had lost its pose. ``options``: the format,
    and the name of the file in ``folder``."""
    path = folder.file(options.file)
    if options.columns or options.units:
        raise InputError(f"{path}: format {options.format} defines columns and units: remove columns and units")
    if options.format == "kitti" and options.times is None:
        raise InputError(f"{path}: format is kitti, but times is missing: set it to the file with the timestamps")
    if options.format != "kitti" and options.times is not None:
        raise InputError(f"{path}: times is given, but format is {options.format}, not kitti: remove times")
    turned: Turned = options
    if options.times is not None and not options.refuse:
        raise InputError(f"{path}: rows of format kitti cannot be skipped or sorted: remove bad_rows and order")
    if options.times is not None:
        poses = read_kitti(path, folder.file(options.times))
        if not options.axes:
            turned = Turned(axes="body", mounting=options.mounting)  # the format defines the axes
    else:
        poses = read_pose_file(path, "euroc" if options.format == "euroc" else "tum", options)
    folder.warnings += poses.warnings
    offset = round(options.clock_offset * 1e9)
    return poses.stamps() + offset, poses.on_floor(folder.warnings, turned), poses.lost_ns + offset


def _columns(mapped: Cells, offset: float) -> tuple[Integers, dict[str, Array]]:
    return mapped.stamps("t", offset), {n: mapped.numbers(n, COLUMNS[n]) for n in mapped.columns if n != "t"}


def _planar(path: Path, rows: Integers, columns: dict[str, Array], turned: Turned, warnings: list[Notice]) -> Array:
    if "qw" in columns:
        rotations = rotations_of(path, rows, np.column_stack([columns[name] for name in QUATERNION]))
        places = np.column_stack((columns["x"], columns["y"], columns.get("z", np.zeros(len(rows)))))
        return on_floor(path, places, rotations, warnings, turned)
    if turned.is_given():
        raise InputError(
            f"{path}: axes or mounting is given, but columns lacks qx, qy, qz, qw: add them, or remove axes and mounting"
        )
    heading = columns.get("heading", np.zeros(len(rows)))
    around = np.abs(np.diff(heading, prepend=heading[0]))
    valid = ~((around > LEAST_AROUND) & (around < 360.0))
    require(valid, path, rows, "heading", heading, 'radians; it wraps at 360 as degrees do: set units.heading = "deg"')
    return np.column_stack((columns["x"], columns["y"], se2.wrap(heading)))
