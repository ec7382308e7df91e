"""Trajectories that commands wrote."""

from pathlib import Path

from factorgraph_loc.io.readers.pose_file import read_pose_file
from factorgraph_loc.model.trajectory import Trajectory


def read_tum(path: Path, t0_ns: int = 0) -> Trajectory:
    """The planar trajectory in a TUM file, in seconds after ``t0_ns``."""
    return Trajectory.of(read_pose_file(path), t0_ns)
