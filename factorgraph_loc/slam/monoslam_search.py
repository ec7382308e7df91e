"""Active search: matching of an image's features to the points that the filter predicts.

Davison et al., 2007 (see :mod:`~factorgraph_loc.slam.space_motion`), section III.E: a point is searched in the 99 % ellipse of
its innovation. Outliers are rejected by consensus: each match alone corrects the prediction, and the correction that most others
agree with defines the inliers (Civera, Grasa, Davison, Montiel, "1-Point RANSAC for EKF filtering", Journal of Field Robotics
27(5), 2010). The corrected pixels follow from the innovation covariance, so that all matches are tried, not a random sample.
"""

import numpy as np

from factorgraph_loc.slam.monoslam_state import Innovation, Integers, Truths, squared
from factorgraph_loc.vision.matching import match_guided
from factors.se2 import Array
from factors.update import GATE

FEWEST = 3  # matches that must agree
JOINT = 1.5  # mean squared innovation per degree of freedom below which all are inliers


def agreeing(residual: Array, innovation: Innovation, noise: Array) -> Truths:
    """Which of the ``residual`` (K, 2) [px], measured minus predicted, are inliers; all if fewer than :data:`FEWEST`."""
    count = len(residual)
    each = innovation.each(noise)
    if count < FEWEST:
        return np.ones(count, dtype=bool)
    whitened = np.linalg.solve(innovation.root(noise), residual.ravel())
    if whitened @ whitened < JOINT * 2 * count:
        return np.ones(count, dtype=bool)
    blocks = innovation.covariance.reshape(count, 2, count, 2).transpose(0, 2, 1, 3)  # (of j, by i)
    gains = blocks @ np.linalg.inv(each)[None]
    corrected = residual[:, None] - np.einsum("jiab,ib->jia", gains, residual)
    spread = each[:, None] - gains @ blocks.transpose(0, 1, 3, 2)
    # rounding must not leave less than the noise
    spread[..., 0, 0] = np.maximum(spread[..., 0, 0], noise[:, None, 0, 0])
    spread[..., 1, 1] = np.maximum(spread[..., 1, 1], noise[:, None, 1, 1])
    distances = squared(corrected.reshape(-1, 2), spread.reshape(-1, 2, 2)).reshape(count, count)
    i = np.arange(count)
    distances[i, i] = squared(residual, each)
    inside = distances < GATE
    cost = np.minimum(distances, GATE).sum(axis=0)
    best = int(np.argmin(cost))
    return np.asarray(inside[:, best])


def find(
    descriptors: Array, predicted: Array, covariances: Array, pixels: Array, candidates: Array, *, binary: bool
) -> tuple[Integers, Integers]:
    """Matching rows of the points (``descriptors`` (N, D), predicted at ``predicted`` (N, 2) with ``covariances`` (N, 2, 2)) and
    of the features (``candidates`` (M, D) at ``pixels`` (M, 2)), each at most once.
    """
    matches = match_guided(descriptors, candidates, predicted, covariances, pixels, binary=binary)
    return matches.indices[:, 0], matches.indices[:, 1]
