"""Trajectories as files of KITTI; those of TUM are written by :func:`~factorgraph_loc.model.trajectory.write_tum`.

A row of KITTI is the upper three rows of a pose (4, 4), row by row: A. Geiger, P. Lenz, R. Urtasun, "Are we ready for autonomous
driving? The KITTI vision benchmark suite", CVPR 2012. The stamps are in a file of their own, one a row.
"""

from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import write_text
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.trajectory3 import Trajectory3
from factors.se2 import Array

TIMES_SUFFIX = ".times.txt"


def matrices(trajectory: Trajectory | Trajectory3) -> Array:
    """The poses (N, 3, 4) of the robot in the world: rotation and position."""
    if isinstance(trajectory, Trajectory3):
        return np.concatenate((trajectory.rotations, trajectory.positions[:, :, None]), axis=2)
    x, y, heading = trajectory.poses.T
    out = np.zeros((len(trajectory), 3, 4))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(heading)
    out[:, 1, 0] = np.sin(heading)
    out[:, 0, 1] = -np.sin(heading)
    out[:, 2, 2] = 1.0
    out[:, 0, 3], out[:, 1, 3] = x, y
    return out


def write_kitti(trajectory: Trajectory | Trajectory3, path: Path) -> Path:
    """Write poses of KITTI, and their stamps [s from the log's start] beside them, as ``NAME.times.txt``, whose path is returned.

    The frame is the robot's, x forward, z up, and not that of a camera; nothing is shifted to start at the origin.
    """
    rows = matrices(trajectory).reshape(-1, 12)
    times = path.with_name(path.stem + TIMES_SUFFIX)
    try:
        write_text(path, "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows.tolist()))
        write_text(times, "".join(f"{t:.9f}\n" for t in trajectory.t.tolist()))
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
    return times
