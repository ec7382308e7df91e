"""Export of trajectories in KITTI format; for TUM see :func:`~factorgraph_loc.model.trajectory.write_tum`.

KITTI: each row contains the upper three rows of a pose (4, 4), row by row: A. Geiger, P. Lenz, R. Urtasun, "Are we ready for
autonomous driving? The KITTI vision benchmark suite", CVPR 2012. Stamps are in a separate file, one per row.
"""

from pathlib import Path

import numpy as np

from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.model.pose_path import PosePath
from factorgraph_loc.model.trajectory import Trajectory, write_tum


def write_trajectory(trajectory: Trajectory | PosePath, path: str | Path, t0_ns: int = 0) -> list[Path]:
    """Write a trajectory in TUM format, or in KITTI format if the name ends with .kitti; return the files. ``t0_ns``: time zero of
    a planar one.

    In KITTI format times [s], of a planar trajectory from the log's start, go to ``NAME.times.txt``. Poses are of the robot's frame
    (x forward, z up), not of a camera, and not relative to the first one.
    """
    path = Path(path)
    if path.suffix != ".kitti":
        write_tum(trajectory, path, t0_ns)
        return [path]
    poses = trajectory.path("trajectory") if isinstance(trajectory, Trajectory) else trajectory
    rows = np.concatenate((poses.rotations, poses.positions[:, :, None]), axis=2).reshape(-1, 12)
    t = trajectory.t if isinstance(trajectory, Trajectory) else trajectory.seconds()
    times = path.with_name(path.stem + ".times.txt")
    with writing(path):
        write_text(path, "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows.tolist()))
        write_text(times, "".join(f"{seconds:.9f}\n" for seconds in t.tolist()))
    return [path, times]
