"""Poses in space as planar estimates."""

import numpy as np

from factorgraph_loc.model.belief import PoseEstimate, SpacePose
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.trajectory3 import Trajectory3
from factors.se2 import Array


def planar_estimate(t: float, pose: SpacePose) -> PoseEstimate:
    """A localized estimate of (x, y) and of the direction of the robot's first axis, seen from above, with covariance; it
    contains the pose in space too.
    """
    rotation = pose.rotation
    x, y = rotation[0, 0], rotation[1, 0]
    jacobian = np.zeros((3, 6))
    jacobian[:2, 3:] = rotation[:2]
    # a small rotation (a, b, c) moves the first axis by c times the second minus b times the third
    across = np.array((-y, x)) / max(x * x + y * y, 1e-12)
    jacobian[2, 1], jacobian[2, 2] = -across @ rotation[:2, 2], across @ rotation[:2, 1]
    seen: Array = np.array((pose.position[0], pose.position[1], np.arctan2(y, x)))
    return PoseEstimate(t, seen, jacobian @ pose.covariance @ jacobian.T, "localized", pose)


def planar_trajectory(found: Trajectory3) -> Trajectory:
    """A trajectory in space, with covariances, seen from above."""
    assert found.covariances is not None, "an estimate has covariances"
    rows = zip(found.t.tolist(), found.positions, found.rotations, found.covariances, strict=True)
    seen = [planar_estimate(t, SpacePose(*pose)) for t, *pose in rows]
    poses = np.array([e.pose for e in seen]).reshape(-1, 3)
    return Trajectory(found.t, poses, np.array([e.covariance for e in seen]).reshape(-1, 3, 3))
