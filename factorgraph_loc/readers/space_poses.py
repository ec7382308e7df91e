"""Poses in space as data sets write them: quaternions in TUM and EuRoC files, 3x4 matrices in KITTI's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_loc.errors import bad_field
from factorgraph_loc.readers.columns import read_columns
from factorgraph_loc.trajectory import Integers
from factorgraph_loc.trajectory3 import Trajectory3
from factors import reprojection
from factors.se2 import Array

UNIT = 0.01  # what the length of a quaternion may be off
ORTHONORMAL = 2e-3  # and a rotation matrix: KITTI's have seven digits
MATRIX = tuple(f"{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))


def rotations_of(path: Path, rows: Integers, quaternions: Array) -> Array:
    """Rotations (N, 3, 3) of quaternions (N, 4) as x, y, z, w; InputError at one that is no unit quaternion."""
    length = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(~(np.abs(length - 1.0) <= UNIT))
    if len(bad):
        i = int(bad[0])
        raise bad_field(path, "length of the quaternion", float(length[i]), "1", row=int(rows[i]))
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def headings_of(path: Path, rows: Integers, quaternions: Array) -> Array:
    """Where the first axis points, seen from above (N,) [rad]."""
    rotations = rotations_of(path, rows, quaternions)
    return np.asarray(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))


def read_kitti(path: Path, times: Path) -> tuple[Integers, Integers, Trajectory3]:
    """Rows (N,), stamps (N,) [ns] and poses of a KITTI odometry file, whose stamps are the lines of ``times``.

    The file's poses are of a camera that looks along z, with y down, in the frame of the first of them (Geiger, Lenz, Urtasun, "Are
    we ready for autonomous driving?", CVPR 2012). Here z is up and x ahead, in world and robot. InputError names file and row.
    """
    table, rows = read_columns(path, MATRIX)
    stamps, _ = read_columns(times, ("t",))
    if len(stamps) < len(table):
        raise bad_field(
            times, "number of rows", len(stamps), f"at least {len(table)}, one for each pose of {path.name}"
        )
    matrices = table.reshape(-1, 3, 4)
    rotations = matrices[:, :, :3]
    off = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((off > ORTHONORMAL) | (np.linalg.det(rotations) < 0.0))
    if len(bad):
        i = int(bad[0])
        raise bad_field(path, "rotation", rotations[i].tolist(), "an orthonormal matrix", row=int(rows[i]))
    u, _, vt = np.linalg.svd(rotations)
    ahead = reprojection.FORWARD
    t_ns = np.rint(stamps[: len(table), 0] * 1e9).astype(np.int64)
    t = (t_ns - (t_ns[0] if len(t_ns) else 0)) / 1e9
    stuck = np.flatnonzero(np.diff(t) <= 0.0) + 1
    if len(stuck):
        i = int(stuck[0])
        raise bad_field(times, "t", float(stamps[i, 0]), "a stamp after that of the row before", row=i + 1)
    return rows, t_ns, Trajectory3(t, matrices[:, :, 3] @ ahead.T, ahead @ (u @ vt) @ ahead.T)
