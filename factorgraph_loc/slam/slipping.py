"""Detection of wheel slip between two keyframes, from recently observed points of the graph.

If the wheels slipped, the odometry between the keyframes gets a larger noise. The noise is chosen once, before the
keyframe is added to the graph. The alternative is a factor that chooses the likelier of two noises in each iteration
(Olson, Agarwal, International Journal of Robotics Research 32(7), 2013). Such a factor has many optima, and a graph of
points converges to wrong ones.
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

ENOUGH = 6  # least number of points that must agree with each other
# m^2, rad^2: covariance of a pose from points, due to errors that all points have in common
COMMON_COVARIANCE = np.diag((0.02, 0.02, 0.005)) ** 2


def unless_slipped(
    model: CameraModel,
    keyframe: Keyframe,
    guess: Guess,
    slip: Callable[[Increment], tuple[Array, float]],
    observed: tuple[Array, Array, Array, Array],
) -> Guess:
    """Return ``guess``, the predicted pose of a new keyframe, with a larger covariance if the wheels slipped.

    Slip is detected in the image of the keyframe. If the wheels slipped, the covariance of ``keyframe.from_previous``,
    the motion since the previous keyframe, is increased in place. ``slip``: a function of a motion. It returns the
    covariance (3, 3) that slip adds, and minus the logarithm of the probability of slip. ``observed``: the positions
    (K, 3) of observed points, their pixels (K, 2), and the covariances of both (K, 3, 3) [m^2] and (K, 2, 2) [px^2].
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
    """Return the covariance (3, 3) of the odometry from an earlier keyframe to ``newest``, including detected slip.

    The earlier keyframe is the last one at or before the time ``t`` [s], but at most ``most`` keyframes before
    ``newest``. ``keyframes``: by index. Returns None if ``newest`` has no odometry from its predecessor.
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
    """Return the log-likelihood ratio of an image for two ``covariances`` (3, 3) of the predicted ``pose`` (3,), second
    to first. Returns 0 if too few points agree. ``observed``: positions (K, 3) and pixels (K, 2) of points, and the
    covariances of both."""
    points, pixels, of_points, noise = observed
    agrees = agreeing(model, lifted(model, pose, covariances[1]), points, pixels, noise)
    if np.count_nonzero(agrees) < ENOUGH:
        return 0.0
    factor = ReprojectionFactor(model, points[agrees], pixels[agrees], point_covariances=of_points[agrees])
    update = image_update(factor, pose, covariances[1], ITERATIONS, SETTLED)
    # covariance of the pose from the image alone, without the prediction
    posterior = positive.inverse(update.covariance)
    gained = positive.inverse(positive.nearest(posterior - positive.inverse(covariances[1])))
    off, gained = gained @ posterior @ update.delta, gained + COMMON_COVARIANCE
    return more_probable(off, (covariances[0] + gained, covariances[1] + gained))


def more_probable(off: Array, covariances: tuple[Array, Array]) -> float:
    """Return the log-likelihood ratio of the second to the first of two ``covariances`` (D, D), given an error ``off``
    (D,) with mean zero."""
    fits = [positive.squared(off, covariance) + np.linalg.slogdet(covariance)[1] for covariance in covariances]
    return 0.5 * float(fits[0] - fits[1])
