"""Reads trajectories from files in TUM, EuRoC or KITTI format, which is recognized by the first row.

TUM and EuRoC files have positions and quaternions. KITTI files have matrices (3, 4) of rotation and position.
"""

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from factorgraph_loc.errors import InputError, bad_field, require
from factorgraph_loc.files import checks
from factorgraph_loc.files.cells import Cells
from factorgraph_loc.files.column_mapping import ColumnMapping, TimedMapping, read_mapped
from factorgraph_loc.files.columns import POSES, PURE, STAMP, unit_since_1970, within
from factorgraph_loc.files.models import FARTHEST, read_text
from factorgraph_loc.files.row_rules import RowRules
from factorgraph_loc.model.planar import are_null, not_unit, null_poses, rotations_of
from factorgraph_loc.model.pose_path import PosePath
from factorgraph_loc.text import Notice, notice
from factors.camera import model as reprojection
from factors.se2 import Array, Integers

ORTHONORMAL = 2e-3  # tolerance of the products of rows of a rotation matrix, because KITTI files have few digits
MATRIX = tuple(f"{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))
ENTRY = within("entry", PURE, FARTHEST, "of the matrix of a pose")
# the columns of these formats; a EuRoC file may have further columns, velocities and biases, which are not used
EUROC = ("t", "x", "y", "z", "qw", "qx", "qy", "qz")
TUM = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
Format = Literal["tum", "kitti", "euroc"]
FORMATS: dict[Format, str] = {
    "tum": "8 values (TUM: t x y z qx qy qz qw)",
    "kitti": "12 (KITTI)",
    "euroc": "8 or more with commas (EuRoC: t, x, y, z, qw, qx, qy, qz)",
}
EXPECTED = "{tum}, {kitti}, or {euroc}".format(**FORMATS)


def read_kitti(path: Path, times: Path) -> PosePath:
    """Return the poses of a KITTI odometry file. ``times``: the file with a timestamp per line.

    The file has poses of a camera with z forward and y down, in the frame of its first pose. They are converted to axes
    with x forward and z up. Raises InputError with file and row of an invalid value. Format: Geiger, Lenz, Urtasun,
    "Are we ready for autonomous driving?", CVPR 2012.
    """
    matrices = read_matrices(path)
    t_ns = read_times(times)
    if len(t_ns) < len(matrices):
        expected = f"at least {len(matrices)}, one for each pose of {path.name}"
        raise bad_field(times, "number of rows", len(t_ns), expected)
    u, _, vt = np.linalg.svd(matrices[:, :, :3])
    ahead = reprojection.FORWARD
    return PosePath(str(path), matrices[:, :, 3] @ ahead.T, ahead @ (u @ vt) @ ahead.T, t_ns[: len(matrices)])


def read_matrices(path: Path) -> Array:
    """Return the poses (N, 3, 4), rotation and position, of a file in KITTI format, with the axes of the file.

    Raises InputError with file and row of an invalid value.
    """
    cells = _read(path, MATRIX, " ")
    matrices = np.column_stack([cells.numbers(field, ENTRY) for field in MATRIX]).reshape(-1, 3, 4)
    rotations = matrices[:, :, :3]
    off = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
    valid = ~((off > ORTHONORMAL) | (np.linalg.det(rotations) < 0.0))
    require(valid, path, cells.rows, "rotation", rotations, "an orthonormal matrix")
    return matrices


def read_times(path: Path) -> Integers:
    """Return the timestamps (N,) [ns] of a file with one timestamp [s] per line. Raises InputError if they do not increase."""
    cells = _read(path, ("t",), " ", "s")
    t_ns = cells.stamps("t")
    require(np.diff(t_ns) > 0, path, cells.rows[1:], "time", t_ns[1:], "more nanoseconds than in the row before")
    return t_ns


def _read(
    path: Path,
    columns: Sequence[str],
    separator: Literal[" ", ","],
    unit: str | None = None,
    rules: RowRules | None = None,
) -> Cells:
    """Return the cells of a file without header that begins with these ``columns``. ``unit``: the unit of the times.

    ``rules``: whether invalid rows are skipped, and rows sorted by time. None: invalid and unsorted rows are errors."""
    numbered = {name: str(i) for i, name in enumerate(columns, start=1)}
    units: dict[str, str | float] = {} if unit is None else {"t": unit}
    form: dict[str, Any] = {"columns": numbered, "units": units, "separator": separator, "header": False}
    if rules is None:
        return read_mapped(path, ColumnMapping(file=path.name, **form), (columns,))
    mapping = TimedMapping(file=path.name, **form, bad_rows=rules.bad_rows, order=rules.order)
    return replace(read_mapped(path, mapping, (columns,)), rules=rules)


def read_pose_file(path: Path, kind: Format | None = None, rules: RowRules | None = None) -> PosePath:
    """Return the poses of a file in TUM, KITTI or EuRoC format. Their field ``warnings`` has warnings about it.

    ``kind``: the expected format, by default any. ``rules``: whether invalid rows are skipped, and rows sorted by time.
    By default an invalid row and a decreasing timestamp are errors. Of poses with equal timestamps, the last is used. A
    pose with a zero quaternion, which means that it was lost, is skipped with a warning. Raises InputError with file
    and row of an invalid value.
    """
    row, first = _first_row(path)
    detected = _format(first)
    if detected is None or kind not in (None, detected):
        raise bad_field(path, "row", first, EXPECTED if kind is None else FORMATS[kind], row=row)
    if detected == "kitti":
        matrices = read_matrices(path)
        return PosePath(str(path), matrices[:, :, 3], matrices[:, :, :3], None)
    warnings: list[Notice] = []
    unit = "s" if detected == "tum" else "ns"
    if detected == "tum" and (larger := _unit(first)) not in (None, "s"):
        unit = str(larger)
        sentence = "{source}: the timestamps are too large for seconds and are read in {unit}"
        warnings.append(notice("unit_of_stamps", sentence, path.name, unit))
    columns, separator = (TUM, " ") if detected == "tum" else (EUROC, ",")
    cells = _read(path, columns, cast(Literal[" ", ","], separator), unit, rules)
    cells = replace(cells, labels={})  # errors then name columns instead of numbering them
    cells = cells.usable({"t": STAMP} | {name: POSES[name] for name in TUM[1:]}, warnings)
    quaternions = np.column_stack([cells.numbers(name, POSES[name]) for name in TUM[4:]])
    null = are_null(quaternions)
    lost_ns = cells.stamps("t")[null]
    if null.any():
        warnings.append(null_poses(path, int(cells.rows[null.argmax()]), len(lost_ns)))
    cells, quaternions = cells.rows_at(np.flatnonzero(~null)), quaternions[~null]
    cells = cells.without([not_unit(quaternions)], warnings)
    table = np.column_stack([cells.numbers(name, POSES[name]) for name in TUM[1:]])
    t_ns, rotations = cells.stamps("t"), rotations_of(path, cells.rows, table[:, 3:])
    keep = checks.in_order(path, cells.rows, t_ns, warnings, rules)
    path_of = PosePath(str(path), table[:, :3], rotations, t_ns, lost_ns=lost_ns)
    return replace(path_of.rows(keep), warnings=tuple(warnings))


def _unit(first: str) -> str | None:
    """Return the unit of the timestamp in the row ``first``, by its size. Returns None if it is not a time since 1970."""
    try:
        return unit_since_1970(float(first.split(maxsplit=1)[0]))
    except ValueError:
        return None


def is_pose_file(path: Path) -> bool:
    """True if the first row of a file has only numbers, as many as TUM, KITTI or EuRoC format has."""
    try:
        _, first = _first_row(path)
        return _format(first) is not None and bool([float(part) for part in first.replace(",", " ").split()])
    except (InputError, ValueError):
        return False


def _format(first: str) -> Format | None:
    """Return the format of a file by its first row. Returns None if no format has such a row."""
    if "," in first:
        return "euroc" if first.count(",") + 1 >= len(EUROC) else None
    count = len(first.split())
    return "tum" if count == len(TUM) else "kitti" if count == len(MATRIX) else None


def _first_row(path: Path) -> tuple[int, str]:
    for row, line in enumerate(io.StringIO(read_text(path)), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            return row, line.strip()
    raise InputError(f"{path}: contains no poses, expected at least one row")
