"""A planar robot's motion between two images, from what was followed from one to the other.

Least squares of Sampson's error over the turn and the direction of the way (:mod:`factors.camera.visual_odometry`), with Huber's
loss, from a robust start: of the motions that two matches each allow, the one that most of the matches agree with (Fischler and
Bolles, CACM 24(6), 1981; two matches are enough in a plane: Ortin and Montiel, Robotica 19, 2001). How far the robot went is not
seen: that stays as it was predicted, and the information along it is zero.

Where a turn alone explains most matches, as for a robot at rest, the direction of the way is noise, or that of a thing that moves.
Then only the turn is told: by least squares of the pixels themselves, with what the points may be displaced by the little way that
the odometry allows as further unknowns.

The information is that of Gaussian noise, to first order. Where the way is short against the noise of the pixels its direction is
biased besides, as it is where all points lie in one plane: such motions are not told.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.camera.model import CameraModel, huber_weight
from factors.camera.visual_odometry import RayPairs, from_epipole, nearness, sampson, translation
from factors.motion import Increment
from factors.se2 import Array

MIN_MATCHES = 8
MIN_SHARE = 0.3  # of the matches that agree, else none is trusted
HYPOTHESES = 50
NEWTON_STEPS, ITERATIONS, HALVINGS = 4, 15, 6
AGREES, CLEAR = 3.0, 20.0  # standard deviations: from its epipolar line, and from the epipole
TURN_AGREES = 3.4  # standard deviations of two numbers: 99.7 %
TURN_EXPLAINS = 0.5  # share of the matches, where the robot may be at rest
DEPTHS = 0.3  # 1/m: how much the inverse depth differs between one side of the image and the other
BLURRED = 0.05  # rad: the standard deviation of a direction that is not worth telling
NEAR, NEAREST = 1.0, 0.5  # m: nearer than that few points are, and none
SHORTEST = 1e-4  # m, of a way that has a direction
SMALLEST = 1e-7  # of a step, m and rad


@dataclass(frozen=True)
class FrameMotion:
    """A robot's motion between two images.

    ``delta`` (3,): pose at the second image in the frame of the first, as long as it was predicted. ``information`` (3, 3): of its
    body-frame perturbation, of rank 2, or 1 where only the turn is told. ``agrees`` (K,): which matches it explains.
    """

    delta: Array
    information: Array
    agrees: NDArray[np.bool_]


def frame_motion(
    model: CameraModel, first: Array, second: Array, predicted: Increment, rng: np.random.Generator
) -> FrameMotion | None:
    """The motion between two images, in which the same K things are seen at the pixels ``first`` and ``second`` (K, 2), and that is
    ``predicted`` by odometry. None with too few matches, or where too few agree."""
    if len(first) < MIN_MATCHES:
        return None
    pairs = RayPairs.of(model, first, second)
    turn = _turn(pairs, predicted, model.robust)
    way = float(np.linalg.norm(translation(pairs.position, predicted.delta)))
    may_rest = way < AGREES * float(np.sqrt(np.trace(predicted.covariance[:2, :2])))
    if may_rest and turn.agrees.mean() >= TURN_EXPLAINS:
        return turn
    moved = _refined(pairs, _start(pairs, predicted.delta, rng), model.robust)
    if moved.agrees.sum() < max(MIN_MATCHES, MIN_SHARE * len(pairs)) or _blur(moved, model.position) > BLURRED:
        return None
    return moved


def _start(pairs: RayPairs, predicted: Array, rng: np.random.Generator) -> Array:
    """The motion that the most matches agree with, of those that two of them allow and the predicted one."""
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
    return float(np.where(_agrees(pairs, motion, residual), residual**2, AGREES**2).sum())


def _agrees(pairs: RayPairs, motion: Array, residual: Array) -> NDArray[np.bool_]:
    """Which matches are seen along their epipolar line, at a place where points may be: one that only happens to lie on its line
    would have to be behind the camera or very near, and would pull the more, the nearer it is."""
    rho, sigma = nearness(pairs, motion)
    return np.asarray((np.abs(residual) < AGREES) & (rho > -AGREES * sigma) & (rho < 1.0 / NEAREST + AGREES * sigma))


def _refined(pairs: RayPairs, motion: Array, robust: float) -> FrameMotion:
    """Least squares with Huber's loss over the matches that agree, chosen anew at each step, which is halved where it leads up."""
    start, misfit = motion, _misfit(pairs, motion)
    for _ in range(ITERATIONS):
        residual, jacobian, signal = sampson(pairs, motion)
        weight = _weight(pairs, motion, residual, robust)
        information = (weight[:, None] * signal).T @ signal
        step = -np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ (jacobian.T @ (weight * residual))
        for _ in range(HALVINGS):
            moved = _stepped(motion, step, start, pairs.position)
            there = _misfit(pairs, moved)
            if there <= misfit:
                break
            step = 0.5 * step
        else:
            break
        motion, misfit = moved, there
        if np.abs(step).max() < SMALLEST:
            break
    residual, _, signal = sampson(pairs, motion)
    weight = _weight(pairs, motion, residual, robust)
    # to first order the rays meet wherever along its way the camera is: of the rest there is none
    signal -= np.outer(signal @ (along := _along(motion, pairs.position)), along)
    return FrameMotion(motion, (weight[:, None] * signal).T @ signal, _agrees(pairs, motion, residual))


def _weight(pairs: RayPairs, motion: Array, residual: Array, robust: float) -> Array:
    clear = from_epipole(pairs, motion) > CLEAR
    return np.asarray(huber_weight(residual**2, robust) * (clear & _agrees(pairs, motion, residual)))


def _along(motion: Array, position: Array) -> Array:
    """The direction (3,) of the camera's way as a perturbation of the robot's motion."""
    way = translation(position, motion)
    x, y = se2.transform_to(np.array((0.0, 0.0, motion[2])), way) / max(float(np.linalg.norm(way)), 1e-12)
    return np.array((x, y, 0.0))


def _stepped(motion: Array, step: Array, like: Array, position: Array) -> Array:
    """``motion`` after a step (3,), the camera's way as long as that of the motion ``like``."""
    moved = se2.compose(motion, se2.exp(np.clip(step, -0.5, 0.5)))
    way, length = translation(position, moved), float(np.linalg.norm(translation(position, like)))
    there = float(np.linalg.norm(way))
    if there > 0.0:
        moved[:2] += way * (max(length, SHORTEST) / there - 1.0)
    return moved


def _blur(moved: FrameMotion, position: Array) -> float:
    """Standard deviation of the direction of the camera's way [rad]."""
    x, y, _ = _along(moved.delta, position)
    basis = np.array(((-y, 0.0), (x, 0.0), (0.0, 1.0)))
    a, b, c = (basis.T @ moved.information @ basis)[[0, 0, 1], [0, 1, 1]]
    left = a - b * b / c if c > 0.0 else 0.0
    return float(1.0 / np.sqrt(left) / np.linalg.norm(translation(position, moved.delta))) if left > 0.0 else np.inf


def _turn(pairs: RayPairs, predicted: Increment, robust: float) -> FrameMotion:
    """The turn alone, and which matches a turn and the little way explain."""
    delta = predicted.delta.copy()
    # of the way over the depth of what is seen, in x and in y
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
    # what the different depths do besides shows in the residual
    excess = max(1.0, float(np.sum(weight[:, None] * residual**2)) / max(2.0 * weight.sum() - 1.0, 1.0))
    told = normal[0, 0] - normal[0, 1:] @ np.linalg.solve(normal[1:, 1:], normal[1:, 0])
    variance = excess / max(told, 1e-9) + (DEPTHS * NEAR * allowed) ** 2
    return FrameMotion(delta, np.diag((0.0, 0.0, 1.0 / variance)), agrees)


def _likely_turn(pairs: RayPairs, guess: float) -> float:
    """Of the turns that each match suggests by itself the one that the most agree with."""
    residual, jacobian = _displaced(pairs, guess, np.zeros(2))
    own = jacobian[:, :, 0]
    suggested = guess - np.einsum("kr,kr->k", own, residual) / np.maximum(np.einsum("kr,kr->k", own, own), 1e-9)
    candidates = [guess, float(np.median(suggested)), *suggested[:: max(1, len(pairs) // HYPOTHESES)].tolist()]
    counts = [int(_explained(_displaced(pairs, turn, np.zeros(2))[0]).sum()) for turn in candidates]
    return float(candidates[int(np.argmax(counts))])


def _displaced(pairs: RayPairs, turn: float, shift: Array) -> tuple[Array, Array]:
    """Whitened distance (K, 2) between where things are seen at first and where a turn, and the camera's way over the depth
    ``shift`` (2,), put them after what is seen later; its Jacobian (K, 2, 3) by the turn and the shift."""
    c, s = np.cos(turn), np.sin(turn)
    b = pairs.second
    ahead = np.column_stack((c * b[:, 0] - s * b[:, 1] + shift[0], s * b[:, 0] + c * b[:, 1] + shift[1], b[:, 2]))
    turned = ahead[:, :2] - shift
    by = np.zeros((len(b), 3, 3))
    by[:, 0, 0], by[:, 1, 0], by[:, 0, 1], by[:, 1, 2] = -turned[:, 1], turned[:, 0], 1.0, 1.0
    # the noise of both pixels, as if it were all in the first: the camera's two axes in the image, and its own one
    inverse = np.linalg.inv(
        np.concatenate((pairs.first_noise, np.broadcast_to(pairs.axis[:, None], (len(b), 3, 1))), axis=2)
    )
    here, by = np.einsum("kij,kj->ki", inverse, ahead), inverse @ by
    there = np.einsum("kij,kj->ki", inverse, pairs.first)
    depth = np.maximum(here[:, 2:], 0.05)
    residual = (here[:, :2] / depth - there[:, :2]) / np.sqrt(2.0)
    jacobian = (by[:, :2] - here[:, :2, None] / depth[:, :, None] * by[:, 2:]) / depth[:, :, None] / np.sqrt(2.0)
    return residual, jacobian


def _turn_weight(residual: Array, robust: float) -> Array:
    squared = np.einsum("kr,kr->k", residual, residual)
    return np.asarray(huber_weight(squared, robust) * (squared < TURN_AGREES**2))


def _explained(residual: Array) -> NDArray[np.bool_]:
    return np.asarray(np.einsum("kr,kr->k", residual, residual) < TURN_AGREES**2)
