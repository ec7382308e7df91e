"""Motion of a planar robot between two images, from tracked features.

Least squares of Sampson's error over the rotation and the direction of translation (:mod:`factors.camera.visual_odometry`), with
Huber loss. Each pair of matches defines a motion; the one with most inliers is the initial value (Fischler and Bolles, CACM 24(6),
1981; two matches suffice in a plane: Ortin and Montiel, Robotica 19, 2001). The distance is unobservable: it keeps its predicted
value, with zero information.

If a rotation without translation explains most matches, as for a robot at rest, the direction of translation is noise or that of
a moving object. Then only the rotation is estimated, by least squares of the pixels. The small displacement allowed by odometry is
estimated with it.

The information is for Gaussian noise, to first order. For a translation that is short relative to the pixel noise, or if all
points lie in one plane, its direction is biased; such motions are rejected.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.camera.model import CameraModel
from factors.camera.visual_odometry import RayPairs, from_epipole, nearness, sampson, translation
from factors.motion import Increment
from factors.robust import huber_weight
from factors.se2 import Array

MIN_MATCHES = 8
MIN_SHARE = 0.3  # least fraction of inliers
HYPOTHESES = 50
NEWTON_STEPS, ITERATIONS, HALVINGS = 4, 15, 6
INLIER_GATE, EPIPOLE_GATE = (
    3.0,
    20.0,
)  # standard deviations: inliers to their epipolar line, and least distance from the epipole
TURN_AGREES = 3.4  # standard deviations of two values: 99.7 %
TURN_EXPLAINS = 0.5  # fraction of matches explained by a rotation if the robot may be at rest
DEPTHS = 0.3  # 1/m: variation of the inverse depth across the image
DIRECTION_SIGMA = 0.05  # rad: largest standard deviation of a useful direction
NEAR, NEAREST = 1.0, 0.5  # m: few points are nearer, and none
SHORTEST = 1e-4  # m, least translation with a direction
SCALED = 0.01  # of the focal length, for its derivative
WORST = 1e12  # condition of the information of two images
SMALLEST = 1e-7  # m and rad: converged step


@dataclass(frozen=True)
class FrameMotion:
    """The motion of a robot between two images.

    ``delta`` (3,): pose at the second image in the frame of the first, with the predicted distance. ``information`` (3, 3): of
    its body-frame perturbation, of rank 2, or 1 for a rotation only. ``agrees`` (K,): the inliers.
    """

    delta: Array
    information: Array
    agrees: NDArray[np.bool_]


def frame_motion(
    model: CameraModel, first: Array, second: Array, predicted: Increment, rng: np.random.Generator
) -> FrameMotion | None:
    """The motion between two images with K features at the pixels ``first`` and ``second`` (K, 2), ``predicted`` by odometry.

    None with too few matches or too few inliers."""
    if len(first) < MIN_MATCHES:
        return None
    pairs = RayPairs.of(model, first, second)
    turn = _turn(pairs, predicted, model.robust)
    distance = float(np.linalg.norm(translation(pairs.position, predicted.delta)))
    may_rest = distance < INLIER_GATE * float(np.sqrt(np.trace(predicted.covariance[:2, :2])))
    if may_rest and turn.agrees.mean() >= TURN_EXPLAINS:
        return turn
    moved = _refined(pairs, _start(pairs, predicted.delta, rng), model.robust)
    if moved.agrees.sum() < max(MIN_MATCHES, MIN_SHARE * len(pairs)) or _blur(moved, model.position) > DIRECTION_SIGMA:
        return None
    return moved


def turned(
    model: CameraModel, first: Array, second: Array, starts: Sequence[Array]
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """The turn of the robot [rad] between two images, and the relative error of the focal length, with standard deviations.

    ``first``, ``second`` (K, 2): pixels of K features. ``starts`` (3,): motions, one of them near the true one. None with too few
    matches or too few inliers.
    """
    if len(first) < MIN_MATCHES:
        return None
    pairs = RayPairs.of(model, first, second)
    refined = _refined(pairs, min(starts, key=lambda motion: _misfit(pairs, motion)), model.robust)
    if refined.agrees.sum() < max(MIN_MATCHES, MIN_SHARE * len(pairs)):
        return None
    residual, _, signal = sampson(pairs, refined.delta)
    weight = _weight(pairs, refined.delta, residual, model.robust)
    longer, shorter = (
        sampson(RayPairs.of(replace(model, fx=s * model.fx, fy=s * model.fy), first, second), refined.delta)[0]
        for s in (1.0 + SCALED, 1.0 - SCALED)
    )
    by_focal = (longer - shorter) / (2.0 * SCALED)
    # there is no information along the translation, only across it and of the rotation
    x, y, _ = _along(refined.delta, pairs.position)
    jacobian = np.column_stack((signal @ (-y, x, 0.0), signal[:, 2], by_focal))
    information = (weight[:, None] * jacobian).T @ jacobian
    if np.linalg.cond(information) > WORST:
        return None
    covariance = np.linalg.inv(information)
    focal = -float(covariance[2] @ (jacobian.T @ (weight * residual)))
    turn_sigma = math.sqrt(np.linalg.inv(information[:2, :2])[1, 1])
    return (float(refined.delta[2]), turn_sigma), (focal, math.sqrt(covariance[2, 2]))


def _start(pairs: RayPairs, predicted: Array, rng: np.random.Generator) -> Array:
    """The motion with most inliers, of those defined by pairs of matches and the predicted one."""
    best, least = predicted, _misfit(pairs, predicted)
    for _ in range(HYPOTHESES):
        two = pairs.chosen(rng.choice(len(pairs), 2, replace=False))
        motion = predicted
        for _ in range(NEWTON_STEPS):
            residual, jacobian, _ = sampson(two, motion)
            step = np.asarray(np.linalg.lstsq(jacobian, -residual, rcond=1e-9)[0], dtype=float)
            motion = _stepped(motion, step, predicted, pairs.position)
        misfit = _misfit(pairs, motion)
        if misfit < least:
            best, least = motion, misfit
    return best


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


def _refined(pairs: RayPairs, motion: Array, robust: float) -> FrameMotion:
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
    residual, _, signal = sampson(pairs, motion)
    weight = _weight(pairs, motion, residual, robust)
    # to first order the rays intersect for any translation along its direction: there is no information about the distance
    signal -= np.outer(signal @ (along := _along(motion, pairs.position)), along)
    return FrameMotion(motion, (weight[:, None] * signal).T @ signal, _agrees(pairs, motion, residual))


def _weight(pairs: RayPairs, motion: Array, residual: Array, robust: float) -> Array:
    clear = from_epipole(pairs, motion) > EPIPOLE_GATE
    return np.asarray(huber_weight(residual**2, robust) * (clear & _agrees(pairs, motion, residual)))


def _along(motion: Array, position: Array) -> Array:
    """The direction (3,) of the camera's translation as a perturbation of the robot's motion."""
    shift = translation(position, motion)
    x, y = se2.transform_to(np.array((0.0, 0.0, motion[2])), shift) / max(float(np.linalg.norm(shift)), 1e-12)
    return np.array((x, y, 0.0))


def _stepped(motion: Array, step: Array, like: Array, position: Array) -> Array:
    """``motion`` after a step (3,), with the camera's translation as long as that of the motion ``like``."""
    moved = se2.compose(motion, se2.exp(np.clip(step, -0.5, 0.5)))
    shift, length = translation(position, moved), float(np.linalg.norm(translation(position, like)))
    shift_length = float(np.linalg.norm(shift))
    if shift_length > 0.0:
        moved[:2] += shift * (max(length, SHORTEST) / shift_length - 1.0)
    return moved


def _blur(moved: FrameMotion, position: Array) -> float:
    """Standard deviation of the direction of the camera's translation [rad]."""
    x, y, _ = _along(moved.delta, position)
    basis = np.array(((-y, 0.0), (x, 0.0), (0.0, 1.0)))
    a, b, c = (basis.T @ moved.information @ basis)[[0, 0, 1], [0, 1, 1]]
    left = a - b * b / c if c > 0.0 else 0.0
    return float(1.0 / np.sqrt(left) / np.linalg.norm(translation(position, moved.delta))) if left > 0.0 else np.inf


def _turn(pairs: RayPairs, predicted: Increment, robust: float) -> FrameMotion:
    """The rotation alone, and the inliers of a rotation with a small translation."""
    delta = predicted.delta.copy()
    # translation over depth, in x and in y
    allowed = (
        np.linalg.norm(translation(pairs.position, delta)) + np.sqrt(np.trace(predicted.covariance[:2, :2]))
    ) / NEAR
    prior = np.array((0.0, *(2 * (1.0 / max(allowed, SHORTEST),))))
    delta[2] = _likely_turn(pairs, delta[2])
    shift = np.zeros(2)
    agrees = _explained(_displaced(pairs, delta[2], shift)[0])
    for _ in range(ITERATIONS):
        residual, jacobian = _displaced(pairs, delta[2], shift)
        weight = _turn_weight(residual, robust) * agrees
        normal = np.einsum("k,kri,krj->ij", weight, jacobian, jacobian) + np.diag(prior**2)
        pull = np.einsum("k,kri,kr->i", weight, jacobian, residual) + prior**2 * (0.0, *shift)
        step = -np.linalg.solve(normal + 1e-9 * np.eye(3), pull)
        delta[2], shift = se2.wrap_scalar(delta[2] + step[0]), shift + step[1:]
        if np.abs(step).max() < SMALLEST:
            break
    residual, jacobian = _displaced(pairs, delta[2], shift)
    weight = _turn_weight(residual, robust) * agrees
    normal = np.einsum("k,kri,krj->ij", weight, jacobian, jacobian) + np.diag(prior**2)
    # the effect of varying depth is part of the residual
    excess = max(1.0, float(np.sum(weight[:, None] * residual**2)) / max(2.0 * weight.sum() - 1.0, 1.0))
    information = normal[0, 0] - normal[0, 1:] @ np.linalg.solve(normal[1:, 1:], normal[1:, 0])
    variance = excess / max(information, 1e-9) + (DEPTHS * NEAR * allowed) ** 2
    return FrameMotion(delta, np.diag((0.0, 0.0, 1.0 / variance)), agrees)


def _likely_turn(pairs: RayPairs, guess: float) -> float:
    """Of the rotations suggested by single matches the one with most inliers."""
    residual, jacobian = _displaced(pairs, guess, np.zeros(2))
    own = jacobian[:, :, 0]
    suggested = guess - np.einsum("kr,kr->k", own, residual) / np.maximum(np.einsum("kr,kr->k", own, own), 1e-9)
    candidates = [guess, float(np.median(suggested)), *suggested[:: max(1, len(pairs) // HYPOTHESES)].tolist()]
    counts = [int(_explained(_displaced(pairs, turn, np.zeros(2))[0]).sum()) for turn in candidates]
    return float(candidates[int(np.argmax(counts))])


def _displaced(pairs: RayPairs, turn: float, shift: Array) -> tuple[Array, Array]:
    """Whitened residuals (K, 2) and their Jacobian (K, 2, 3) with respect to the rotation and ``shift`` (2,), the camera's
    translation over depth."""
    c, s = np.cos(turn), np.sin(turn)
    b = pairs.second
    ahead = np.column_stack((c * b[:, 0] - s * b[:, 1] + shift[0], s * b[:, 0] + c * b[:, 1] + shift[1], b[:, 2]))
    turned = ahead[:, :2] - shift
    by = np.zeros((len(b), 3, 3))
    by[:, 0, 0], by[:, 1, 0], by[:, 0, 1], by[:, 1, 2] = -turned[:, 1], turned[:, 0], 1.0, 1.0
    # the noise of both pixels in the first image: along the camera's two axes, and along its own
    inverse = np.linalg.inv(
        np.concatenate((pairs.first_noise, np.broadcast_to(pairs.axis[:, None], (len(b), 3, 1))), axis=2)
    )
    predicted, by = np.einsum("kij,kj->ki", inverse, ahead), inverse @ by
    measured = np.einsum("kij,kj->ki", inverse, pairs.first)
    depth = np.maximum(predicted[:, 2:], 0.05)
    residual = (predicted[:, :2] / depth - measured[:, :2]) / np.sqrt(2.0)
    jacobian = (by[:, :2] - predicted[:, :2, None] / depth[:, :, None] * by[:, 2:]) / depth[:, :, None] / np.sqrt(2.0)
    return residual, jacobian


def _turn_weight(residual: Array, robust: float) -> Array:
    squared = np.einsum("kr,kr->k", residual, residual)
    return np.asarray(huber_weight(squared, robust) * (squared < TURN_AGREES**2))


def _explained(residual: Array) -> NDArray[np.bool_]:
    return np.asarray(np.einsum("kr,kr->k", residual, residual) < TURN_AGREES**2)
