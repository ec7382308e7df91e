"""Detection of slip of the wheels between two keyframes, from recently seen points of the graph.

A factor that chooses the likelier of two noises (Olson, Agarwal, International Journal of Robotics Research 32(7), 2013) has many
optima, and a graph of points converges to wrong ones. The noise is therefore chosen once, before the keyframe enters the graph.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from factorgraph_loc.fusion.graph.graph import Guess, Keyframe
from factorgraph_loc.sensors.camera.known_points import ITERATIONS, SETTLED, lifted
from factorgraph_loc.vision.consensus import agreeing
from factors import positive
from factors.camera.factor import ReprojectionFactor, image_update
from factors.camera.model import CameraModel
from factors.motion import Increment, propagate
from factors.se2 import Array

ENOUGH = 6  # points that must agree
COMMON_COVARIANCE = np.diag((0.02, 0.02, 0.005)) ** 2  # m, rad: error that all points may have in common


def unless_slipped(
    model: CameraModel,
    keyframe: Keyframe,
    guess: Guess,
    slip: Callable[[Increment], tuple[Array, float]],
    observed: tuple[Array, Array, Array, Array],
) -> Guess:
    """The ``guess`` of the pose of a new keyframe; if wheels slipped on the step to it, both are less certain from now on.

    ``slip``: see :class:`~factorgraph_loc.sensors.motion.Motion`. ``observed``: points (K, 3), their pixels (K, 2), their
    covariances (K, 3, 3), and those (K, 2, 2) of the pixels [px^2].
    """
    step = keyframe.from_previous
    if step is None or keyframe.factor is not None or len(observed[0]) < ENOUGH:
        return guess
    added, rarity = slip(step)
    if _evidence(model, guess[0], (step.covariance, step.covariance + added), observed) < rarity:
        return guess
    keyframe.from_previous = replace(step, covariance=step.covariance + added)
    return guess[0], guess[1] + added


def moved_since(keyframes: Mapping[int, Keyframe], newest: Keyframe, t: float, most: int) -> Array | None:
    """The covariance (3, 3), slip included, of the motion to the ``newest`` of the ``keyframes``; None if its step is unknown.

    The motion starts at the last keyframe at or before ``t`` [s], or ``most`` steps ago.
    """
    steps: list[Increment] = []
    while newest.t > t and newest.from_previous is not None and len(steps) < most:
        steps.append(newest.from_previous)
        newest = keyframes[newest.index - 1]
    covariance = np.zeros((3, 3))
    for step in reversed(steps):
        covariance = propagate(covariance, step)
    return covariance if steps else None


def _evidence(
    model: CameraModel, pose: Array, covariances: tuple[Array, Array], observed: tuple[Array, Array, Array, Array]
) -> float:
    """The log-likelihood ratio of the image at ``pose`` (3,) for the second of two covariances (3, 3), relative to the first."""
    points, pixels, of_points, noise = observed
    agrees = agreeing(model, lifted(model, pose, covariances[1]), points, pixels, noise)
    if np.count_nonzero(agrees) < ENOUGH:
        return 0.0
    factor = ReprojectionFactor(model, points[agrees], pixels[agrees], point_covariances=of_points[agrees])
    update = image_update(factor, pose, covariances[1], ITERATIONS, SETTLED)
    # information of the image only
    posterior = positive.inverse(update.covariance)
    gained = positive.inverse(positive.nearest(posterior - positive.inverse(covariances[1])))
    off, gained = gained @ posterior @ update.delta, gained + COMMON_COVARIANCE
    return more_probable(off, (covariances[0] + gained, covariances[1] + gained))


def more_probable(off: Array, covariances: tuple[Array, Array]) -> float:
    """The log-likelihood ratio of an error ``off`` (D,) for the second of two covariances (D, D), relative to the first."""
    fits = [positive.squared(off, covariance) + np.linalg.slogdet(covariance)[1] for covariance in covariances]
    return 0.5 * float(fits[0] - fits[1])
