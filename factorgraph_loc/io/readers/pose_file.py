"""Files of poses in TUM, EuRoC or KITTI format, recognized by their first row.

Poses are quaternions in TUM and EuRoC files, and 3x4 matrices in KITTI files.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.column_mapping import ColumnMapping, read_mapped
from factorgraph_loc.files.columns import POSES, PURE, within
from factorgraph_loc.files.models import FARTHEST, read_text
from factorgraph_loc.model.planar import rotations_of
from factorgraph_loc.model.trajectory import read_tum_rows
from factorgraph_loc.model.trajectory3 import PosePath, Trajectory3
from factors.camera import model as reprojection
from factors.se2 import Array, Integers

ORTHONORMAL = 2e-3  # tolerance of rotation matrices: KITTI's have seven digits
MATRIX = tuple(f"{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))
ENTRY = within("entry", PURE, FARTHEST, "of the matrix of a pose")
# the columns of these formats; velocities and biases of EuRoC's are not used
EUROC = ("t", "x", "y", "z", "qw", "qx", "qy", "qz")
TUM = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
Format = Literal["tum", "kitti", "euroc"]
EXPECTED = (
    "8 values (TUM: t x y z qx qy qz qw), 12 (KITTI), or 8 or more with commas (EuRoC: t, x, y, z, qw, qx, qy, qz)"
)


def read_kitti(path: Path, times: Path) -> tuple[Integers, Integers, Trajectory3]:
    """Rows (N,), timestamps (N,) [ns] and poses of a KITTI odometry file, whose timestamps are the lines of ``times``.

    The file's poses are those of a camera with z forward and y down, in the frame of the first one (Geiger, Lenz, Urtasun, "Are we
    ready for autonomous driving?", CVPR 2012). They are converted to x forward and z up. InputError names file and row.
    """
    rows, matrices = read_matrices(path)
    t_ns = stamps_of(path, len(rows), times)
    u, _, vt = np.linalg.svd(matrices[:, :, :3])
    ahead = reprojection.FORWARD
    return rows, t_ns, Trajectory3((t_ns - t_ns[0]) / 1e9, matrices[:, :, 3] @ ahead.T, ahead @ (u @ vt) @ ahead.T)


def stamps_of(path: Path, count: int, times: Path) -> Integers:
    """The timestamps (N,) [ns] of the ``count`` poses of ``path``, the first lines of ``times``; InputError if it has fewer."""
    stamps = read_times(times)
    if len(stamps) < count:
        raise bad_field(times, "number of rows", len(stamps), f"at least {count}, one for each pose of {path.name}")
    return stamps[:count]


def read_matrices(path: Path) -> tuple[Integers, Array]:
    """Rows (N,) and poses (N, 3, 4), rotation and position, of a file in KITTI's format, as they are written. InputError names
    file and row."""
    columns = {field: str(i) for i, field in enumerate(MATRIX, start=1)}
    mapping = ColumnMapping(file=path.name, columns=columns, separator=" ", header=False)
    mapped = read_mapped(path, mapping, (MATRIX,))
    rows = mapped.rows
    matrices = np.column_stack([mapped.numbers(field, ENTRY) for field in MATRIX]).reshape(-1, 3, 4)
    rotations = matrices[:, :, :3]
    off = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((off > ORTHONORMAL) | (np.linalg.det(rotations) < 0.0))
    if len(bad):
        i = int(bad[0])
        raise bad_field(path, "rotation", rotations[i].tolist(), "an orthonormal matrix", row=int(rows[i]))
    return rows, matrices


def read_times(path: Path) -> Integers:
    """The timestamps (N,) [ns] of a file with one per line, in seconds; InputError if they do not increase."""
    columns = ColumnMapping(file=path.name, columns={"t": "1"}, units={"t": "s"}, separator=" ", header=False)
    mapped = read_mapped(path, columns, (("t",),))
    t_ns = mapped.stamps("t")
    stuck = np.flatnonzero(np.diff(t_ns) <= 0) + 1
    if len(stuck):
        i = int(stuck[0])
        expected = f"a timestamp after that of the row before, {int(t_ns[i - 1])} ns"
        raise bad_field(path, "time", f"{int(t_ns[i])} ns", expected, row=int(mapped.rows[i]))
    return t_ns


def read_poses(
    path: Path, columns: Sequence[str], *, unit: str, separator: Literal[",", " "], warnings: list[str]
) -> tuple[Integers, Trajectory3]:
    """Timestamps (N,) [ns] and poses, in seconds after the first, of a file with ``columns`` t, x, y, z, qx, qy, qz, qw in any
    order; the last one of equal timestamps. InputError names file and row."""
    named = {name: str(i) for i, name in enumerate(columns, start=1)}
    told = ColumnMapping(file=path.name, columns=named, units={"t": unit}, separator=separator, header=False)
    mapped = read_mapped(path, told, (tuple(columns),))
    numbers = {name: mapped.numbers(name, POSES[name]) for name in columns if name != "t"}
    t_ns = mapped.stamps("t")
    rotations = rotations_of(path, mapped.rows, np.column_stack([numbers[name] for name in ("qx", "qy", "qz", "qw")]))
    positions = np.column_stack([numbers[name] for name in "xyz"])
    keep = checks.in_order(path, mapped.rows, t_ns, warnings)
    t_ns = t_ns[keep]
    return t_ns, Trajectory3((t_ns - t_ns[0]) / 1e9, positions[keep], rotations[keep])


def read_pose_file(path: Path) -> PosePath:
    """The poses in a file of TUM, KITTI or EuRoC format. InputError names file and row."""
    row, first = _first_row(path)
    kind = _format(first)
    warnings: list[str] = []
    if kind is None:
        raise bad_field(path, "row", first, EXPECTED, row=row)
    if kind == "euroc":
        t_ns, poses = read_poses(path, EUROC, unit="ns", separator=",", warnings=warnings)
        return PosePath(str(path), poses.positions, poses.rotations, t_ns, warnings=tuple(warnings))
    if kind == "kitti":
        _, matrices = read_matrices(path)
        return PosePath(str(path), matrices[:, :, 3], matrices[:, :, :3], None)
    rows, t_ns, table = read_tum_rows(path)
    rotations = rotations_of(path, rows, table[:, 3:])
    keep = checks.in_order(path, rows, t_ns, warnings)
    return PosePath(str(path), table[:, :3], rotations, t_ns, warnings=tuple(warnings)).rows(keep)


def is_pose_file(path: Path) -> bool:
    """Whether the first row of a file has numbers alone, as many as one of the formats has."""
    try:
        _, first = _first_row(path)
        return _format(first) is not None and all(map(_is_number, first.replace(",", " ").split()))
    except InputError:
        return False


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _format(first: str) -> Format | None:
    """The format of a file whose first row this is."""
    if "," in first:
        return "euroc" if first.count(",") + 1 >= len(EUROC) else None
    count = len(first.split())
    return "tum" if count == len(TUM) else "kitti" if count == len(MATRIX) else None


def _first_row(path: Path) -> tuple[int, str]:
    for row, line in enumerate(read_text(path).splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            return row, line.strip()
    raise InputError(f"{path}: contains no poses, expected at least one row")
