"""Export of trajectories in KITTI format, and of the pose graph of a run as a g2o file; for TUM see
:func:`~factorgraph_loc.model.trajectory.write_tum`.

KITTI: each row contains the upper three rows of a pose (4, 4), row by row: A. Geiger, P. Lenz, R. Urtasun, "Are we ready for
autonomous driving? The KITTI vision benchmark suite", CVPR 2012. Stamps are in a separate file, one per row.

g2o: R. Kuemmerle, G. Grisetti, H. Strasdat, K. Konolige, W. Burgard, "g2o: a general framework for graph optimization", ICRA 2011,
types ``slam2d``. The file contains the motion between poses (``EDGE_SE2``) and landmarks with simultaneous range and bearing
(``EDGE_SE2_XY``); ranges or bearings alone, tag reads and pixels cannot be represented.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.model.belief import LearntPoint
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import TURN
from factorgraph_loc.model.pose_path import PosePath
from factorgraph_loc.model.trajectory import Trajectory, write_tum
from factorgraph_loc.sensors.landmarks.summary import located_landmarks
from factorgraph_loc.sensors.motion import whole_motion
from factorgraph_loc.sensors.registry import moving
from factorgraph_loc.text import listed
from factors.se2 import Array

LEAST = 1e-12  # m^2 or rad^2: least variance of an edge, to keep its information finite


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


def write_g2o(
    log: Log,
    trajectory: Trajectory,
    sensors: Sequence[str],
    path: Path,
    learnt: Mapping[str, LearntPoint] | None = None,
) -> None:
    """Write the pose graph of a log as a g2o file: poses at the stamps of ``trajectory`` and of the sightings between them,
    numbered from 0, then landmarks. Landmarks of a map are fixed, otherwise the first pose is.

    ``sensors``: the channels of the log to use. Landmarks are those of the map or, if it has none, ``learnt``. Raises
    InputError for fewer than two poses, or a log without odometry.
    """
    used = [name for name in log.streams if name in sensors]
    if not moving(used):
        raise InputError(
            f"{log.name}: has no odometry among {listed(sensors)}, expected it for the edges of a pose graph"
        )
    landmarks = {name: np.array((mark.x, mark.y)) for name, mark in log.world.landmarks.items()}
    if not landmarks:
        landmarks = {name: point.position for name, point in (learnt or {}).items()}
    observed = located_landmarks(log, sensors, landmarks) if len(trajectory) else []
    observed = [s for s in observed if trajectory.t[0] <= s.t <= trajectory.t[-1]]
    t = np.unique(np.concatenate((trajectory.t, [s.t for s in observed])))
    if len(t) < 2:
        raise InputError(f"{log.name}: the run has {len(t)} poses, expected two or more for a pose graph")
    sighted = {s.landmark for s in observed}
    number = {name: len(t) + i for i, name in enumerate(name for name in landmarks if name in sighted)}
    lines = [f"VERTEX_SE2 {i} {_numbers(pose)}" for i, pose in enumerate(trajectory.at(t))]
    lines += [f"VERTEX_XY {number[name]} {_numbers(landmarks[name])}" for name in number]
    motion = whole_motion(log, moving(used, TURN))
    states = [motion.state(at) for at in t.tolist()]
    for i, (a, b) in enumerate(pairwise(states)):
        step = motion.relative(a, b)
        lines.append(f"EDGE_SE2 {i} {i + 1} {_numbers(step.delta)} {_information(step.covariance)}")
    for at, name, point, covariance in observed:
        place = int(np.searchsorted(t, at))
        lines.append(f"EDGE_SE2_XY {place} {number[name]} {_numbers(point)} {_information(covariance)}")
    # last, as GTSAM stops reading here
    lines += [f"FIX {i}" for i in (number.values() if log.world.landmarks and number else (0,))]
    with writing(path):
        write_text(path, "\n".join(lines) + "\n")


def _numbers(values: Array) -> str:
    return " ".join(f"{value:.12g}" for value in np.ravel(values).tolist())


def _information(covariance: Array) -> str:
    """The upper triangle, by rows, of the inverse of a covariance (D, D), regularised for a robot at rest."""
    variances, axes = np.linalg.eigh(covariance)
    inverse = (axes / np.maximum(variances, LEAST)) @ axes.T
    return _numbers(inverse[np.triu_indices(len(covariance))])
