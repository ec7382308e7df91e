"""Export of trajectories in KITTI format; for TUM see :func:`~factorgraph_loc.model.trajectory.write_tum`.

Each row contains the upper three rows of a pose (4, 4), row by row: A. Geiger, P. Lenz, R. Urtasun, "Are we ready for
autonomous driving? The KITTI vision benchmark suite", CVPR 2012. Stamps are in a separate file, one per row.
"""

from pathlib import Path

import numpy as np

from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.results import writing
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.trajectory3 import Trajectory3, upright
from factors.se2 import Array

TIMES_SUFFIX = ".times.txt"


def matrices(trajectory: Trajectory | Trajectory3) -> Array:
    """The poses (N, 3, 4) of the robot in the world: rotation and position."""
    if isinstance(trajectory, Trajectory3):
        return np.concatenate((trajectory.rotations, trajectory.positions[:, :, None]), axis=2)
    out = np.zeros((len(trajectory), 3, 4))
    out[:, :, :3] = upright(trajectory.poses[:, 2])
    out[:, :2, 3] = trajectory.poses[:, :2]
    return out


def write_kitti(trajectory: Trajectory | Trajectory3, path: Path) -> Path:
    """Write poses in KITTI format, and their stamps [s from the log's start] to ``NAME.times.txt`` beside it; return that path.

    Poses are of the robot's frame (x forward, z up), not of a camera, and not relative to the first one.
    """
    rows = matrices(trajectory).reshape(-1, 12)
    times = path.with_name(path.stem + TIMES_SUFFIX)
    with writing(path):
        write_text(path, "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows.tolist()))
        write_text(times, "".join(f"{t:.9f}\n" for t in trajectory.t.tolist()))
    return times
