"""Active search: matching of an image's features to the points that the filter predicts.

Davison et al., 2007 (see :mod:`~factorgraph_loc.slam.monoslam_motion`), section III.E: a point is searched in the 99 % ellipse of
its innovation. Outliers are rejected by consensus: each single match corrects the prediction, and the correction with the most
agreement of other matches defines the inliers (Civera, Grasa, Davison, Montiel, "1-Point RANSAC for EKF filtering", Journal of
Field Robotics 27(5), 2010). The corrected pixels follow from the innovation covariance, so that all matches are tried, not a
random sample. Each inlier must be inside the gate of a prediction from all other inliers.
"""

import numpy as np

from factorgraph_loc.slam.monoslam_state import Innovation, squared
from factorgraph_loc.vision.consensus import Truths
from factors.se2 import Array
from factors.update import GATE

FEWEST = 3  # matches that must agree


def agreeing(residual: Array, innovation: Innovation, noise: Array) -> Truths:
    """Which of K matches are inliers; all if K is below :data:`FEWEST`. ``residual`` (K, 2) [px]: measured minus predicted."""
    count = len(residual)
    right = np.ones(count, dtype=bool)
    if count < FEWEST:
        return right
    total = innovation.total(noise)
    if _confirmed(residual, total, right).all():
        return right
    blocks = innovation.covariance.reshape(count, 2, count, 2).transpose(0, 2, 1, 3)  # (of j, by i)
    each = innovation.each(noise)
    gains = blocks @ np.linalg.inv(each)[None]
    corrected = residual[:, None] - np.einsum("jiab,ib->jia", gains, residual)
    covariances = each[:, None] - gains @ blocks.transpose(0, 1, 3, 2)
    # rounding must not leave less than the noise
    covariances[..., 0, 0] = np.maximum(covariances[..., 0, 0], noise[:, None, 0, 0])
    covariances[..., 1, 1] = np.maximum(covariances[..., 1, 1], noise[:, None, 1, 1])
    distances = squared(corrected.reshape(-1, 2), covariances.reshape(-1, 2, 2)).reshape(count, count)
    i = np.arange(count)
    distances[i, i], covariances[i, i] = squared(residual, each), each
    inside = distances < GATE
    # a match of a very uncertain point has no information, and agrees with everything
    information = np.log(np.linalg.det(each)[:, None] / np.linalg.det(covariances))
    best = int(np.argmax(np.where(inside, GATE - distances + information, 0.0).sum(axis=0)))
    return _confirmed(residual, total, inside[:, best])


def _confirmed(residual: Array, total: Array, right: Truths) -> Truths:
    """The ``right`` matches (K,) inside the gate of a prediction from the other ones; the worst is removed first."""
    rows = np.flatnonzero(right)
    count = len(rows)
    values = (2 * rows[:, None] + np.arange(2)).ravel()
    information, pixels = np.linalg.inv(total[np.ix_(values, values)]), residual[rows].ravel()
    while count >= FEWEST:
        i = np.arange(count)
        own = np.linalg.inv(information.reshape(count, 2, count, 2)[i, :, i, :])
        off = own @ (information @ pixels).reshape(count, 2, 1)  # from the prediction by the others
        distances = squared(off[..., 0], own)
        worst = int(np.argmax(distances))
        if distances[worst] < GATE:
            break
        kept = np.repeat(i != worst, 2)
        cross = information[np.ix_(kept, ~kept)]
        information = information[np.ix_(kept, kept)] - cross @ own[worst] @ cross.T
        rows, pixels, count = np.delete(rows, worst), pixels[kept], count - 1
    confirmed = np.zeros(len(right), dtype=bool)
    confirmed[rows] = True
    return confirmed
