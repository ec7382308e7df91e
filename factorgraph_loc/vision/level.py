"""A robot on a floor that is not quite level: its roll and pitch in an image, and what it would have seen standing upright.

Estimators know x, y and heading. Half a degree of pitch moves all points of an image by several pixels, so it is estimated with
the pose from the points of each image, and taken out of the pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.vision.consensus import CameraPose, moved, root_of, whitened
from factors import positive
from factors.camera import model as reprojection
from factors.camera.model import CameraModel
from factors.robust import huber_weight
from factors.se2 import Array

TILT = 0.005  # rad: standard deviation of roll and pitch on the floor of a building, as in `monoslam`
STEEPEST = 0.06  # rad: what tilts by more is no robot on a floor, or its camera is not mounted as the rig says
RIDGE = 1e-9  # relative, for points that do not tell the pose
STEPS, SETTLED = 5, 1e-3  # rounds, and standard deviations of the prediction that the last may move


@dataclass(frozen=True)
class Stance:
    """``position`` (3,) and ``rotation`` (3, 3) of the camera ``model`` of a robot that tilts. ``kept``: the share of the
    information of an image, from 0 to 1, that is left for x, y and heading."""

    model: CameraModel
    position: Array
    rotation: Array
    kept: float = 1.0

    @classmethod
    def of(cls, model: CameraModel, camera: CameraPose, points: Array, pixels: Array, spreads: Array) -> Stance:
        """The most probable one for a predicted ``camera``, whose covariance has that of :func:`tilting`, and ``points`` (K, 3)
        seen at ``pixels`` (K, 2) with noise covariances ``spreads`` (K, 2, 2) [px^2]."""
        root, whiteners = root_of(camera), positive.whitener(spreads)
        position, rotation, total = camera.position, camera.rotation, np.zeros(6)
        for _ in range(STEPS):
            residual, jacobian = whitened(model, position, rotation, points, pixels, whiteners)
            weight = huber_weight(np.sum(residual**2, axis=1), model.robust)
            gradient = np.einsum("k,kij,ki->j", weight, jacobian, residual)
            information = np.einsum("k,kij,kil->jl", weight, jacobian, jacobian)
            step = -np.linalg.solve(np.eye(6) + root.T @ information @ root, root.T @ gradient + total)
            total = total + step
            (position,), (rotation,) = moved(position[None], rotation[None], (root @ step)[None])
            if np.abs(step).max() < SETTLED:
                break
        return cls(model, position, rotation, _kept(information, _motions(model)))

    @property
    def is_steep(self) -> bool:
        """Whether the robot tilts more than one on a floor does."""
        return math.acos(min(float(self.rotation[2] @ self.model.rotation[2]), 1.0)) > STEEPEST

    def levelled(self, points: Array, pixels: Array) -> Array:
        """The ``pixels`` (K, 2) of ``points`` (K, 3) as the robot would have seen them standing upright at its place."""
        place, turn = reprojection.carrier(self.model, self.position, self.rotation)
        pose = np.array((place[0], place[1], math.atan2(turn[1, 0], turn[0, 0])))
        upright = reprojection.predict(self.model, pose, points)[0]
        seen = reprojection.linearize_in_space(self.model, self.position, self.rotation, points)[0]
        return np.asarray(pixels + upright - seen)


def tilting(model: CameraModel) -> Array:
    """The covariance (6, 6) of the camera's perturbation in its own frame, rotation first, by the tilt of the robot, which turns
    about a point on the floor."""
    by_tilt = _motions(model)[:, 3:]
    return np.asarray(TILT**2 * by_tilt @ by_tilt.T)


def _motions(model: CameraModel) -> Array:
    """How a camera moves (6, 5) with x, y, heading, roll and pitch of its robot."""
    axes = np.eye(3)
    turned = np.hstack((axes @ model.rotation, np.cross(axes, model.position) @ model.rotation))
    moved_along = np.hstack((np.zeros((2, 3)), model.rotation[:2]))
    return np.vstack((moved_along, turned[2:], turned[:2])).T


def _kept(information: Array, motions: Array) -> float:
    """The share of the ``information`` (6, 6) of a camera that is left for x, y and heading where roll and pitch are not known: the
    mean over the three, as their volume says."""
    both = motions.T @ information @ motions
    pose = both[:3, :3] + RIDGE * np.trace(both) * np.eye(3)
    tilt = both[3:, 3:] + np.eye(2) / TILT**2
    left = np.eye(3) - np.linalg.solve(pose, both[:3, 3:] @ np.linalg.solve(tilt, both[3:, :3]))
    return float(np.clip(np.linalg.det(left), 0.0, 1.0) ** (1.0 / 3.0))
