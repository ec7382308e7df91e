"""The turn of a planar robot between two images, and the error of the focal length, from tracked features.

Least squares of Sampson's error over the rotation and the direction of translation (:mod:`factors.camera.ray_pairs`), with Huber
loss. The distance is unobservable: it keeps its initial value.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.camera.model import CameraModel
from factors.camera.ray_pairs import RayPairs, from_epipole, nearness, sampson, translation
from factors.robust import huber_weight
from factors.se2 import Array

MIN_MATCHES = 8
MIN_SHARE = 0.3  # least fraction of inliers
ITERATIONS, HALVINGS = 15, 6
# standard deviations: inliers to their epipolar line, and least distance from the epipole
INLIER_GATE, EPIPOLE_GATE = 3.0, 20.0
NEAREST = 0.5  # m: no point is nearer
SHORTEST = 1e-4  # m, least translation with a direction
SCALED = 0.01  # of the focal length, for its derivative
WORST = 1e12  # condition of the information of two images
SMALLEST = 1e-7  # m and rad: converged step


def measure_turn(
    model: CameraModel, first: Array, second: Array, starts: Sequence[Array]
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """The turn of the robot [rad] between two images, and the relative error of the focal length, with standard deviations.

    ``first``, ``second`` (K, 2): pixels of K features. ``starts`` (3,): motions, one of them near the true one. None with too few
    matches or too few inliers.
    """
    if len(first) < MIN_MATCHES:
        return None
    pairs = RayPairs.of(model, first, second)
    motion = _refined(pairs, min(starts, key=lambda start: _misfit(pairs, start)), model.robust)
    residual, _, signal = sampson(pairs, motion)
    agrees = _agrees(pairs, motion, residual)
    if agrees.sum() < max(MIN_MATCHES, MIN_SHARE * len(pairs)):
        return None
    weight = _weight(pairs, motion, residual, model.robust)
    longer, shorter = (
        sampson(RayPairs.of(replace(model, fx=s * model.fx, fy=s * model.fy), first, second), motion)[0]
        for s in (1.0 + SCALED, 1.0 - SCALED)
    )
    by_focal = (longer - shorter) / (2.0 * SCALED)
    # there is no information along the translation, only across it and of the rotation
    x, y = _direction(motion, pairs.position)
    jacobian = np.column_stack((signal @ (-y, x, 0.0), signal[:, 2], by_focal))
    information = (weight[:, None] * jacobian).T @ jacobian
    if np.linalg.cond(information) > WORST:
        return None
    covariance = np.linalg.inv(information)
    focal = -float(covariance[2] @ (jacobian.T @ (weight * residual)))
    turn_sigma = math.sqrt(np.linalg.inv(information[:2, :2])[1, 1])
    return (float(motion[2]), turn_sigma), (focal, math.sqrt(covariance[2, 2]))


def _misfit(pairs: RayPairs, motion: Array) -> float:
    residual = sampson(pairs, motion)[0]
    return float(np.where(_agrees(pairs, motion, residual), residual**2, INLIER_GATE**2).sum())


def _agrees(pairs: RayPairs, motion: Array, residual: Array) -> NDArray[np.bool_]:
    """Inliers: near their epipolar line and at a plausible depth. A feature that lies on its line by chance would be behind the
    camera or very near, with a large weight."""
    rho, sigma = nearness(pairs, motion)
    return np.asarray(
        (np.abs(residual) < INLIER_GATE) & (rho > -INLIER_GATE * sigma) & (rho < 1.0 / NEAREST + INLIER_GATE * sigma)
    )


def _refined(pairs: RayPairs, motion: Array, robust: float) -> Array:
    """Least squares with Huber loss over the inliers, selected again at each step, with step halving."""
    start, misfit = motion, _misfit(pairs, motion)
    for _ in range(ITERATIONS):
        residual, jacobian, signal = sampson(pairs, motion)
        weight = _weight(pairs, motion, residual, robust)
        information = (weight[:, None] * signal).T @ signal
        step = -np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ (jacobian.T @ (weight * residual))
        for _ in range(HALVINGS):
            moved = _stepped(motion, step, start, pairs.position)
            new_misfit = _misfit(pairs, moved)
            if new_misfit <= misfit:
                break
            step = 0.5 * step
        else:
            break
        motion, misfit = moved, new_misfit
        if np.abs(step).max() < SMALLEST:
            break
    return motion


def _weight(pairs: RayPairs, motion: Array, residual: Array, robust: float) -> Array:
    clear = from_epipole(pairs, motion) > EPIPOLE_GATE
    return np.asarray(huber_weight(residual**2, robust) * (clear & _agrees(pairs, motion, residual)))


def _direction(motion: Array, position: Array) -> Array:
    """The direction (2,) of the camera's translation in the robot frame at the second image."""
    shift = translation(position, motion)
    return se2.transform_to(np.array((0.0, 0.0, motion[2])), shift) / max(float(np.linalg.norm(shift)), 1e-12)


def _stepped(motion: Array, step: Array, like: Array, position: Array) -> Array:
    """``motion`` after a step (3,), with the camera's translation as long as that of the motion ``like``."""
    moved = se2.compose(motion, se2.exp(np.clip(step, -0.5, 0.5)))
    shift, length = translation(position, moved), float(np.linalg.norm(translation(position, like)))
    shift_length = float(np.linalg.norm(shift))
    if shift_length > 0.0:
        moved[:2] += shift * (max(length, SHORTEST) / shift_length - 1.0)
    return moved
