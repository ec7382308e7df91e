"""Matching of descriptors: mutual nearest neighbours that pass the ratio test.

Ratio test: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 60, 2004, section 7.1. Descriptors of type
``uint8`` are bits and are compared by their Hamming distance. Other descriptors are compared by their Euclidean distance.

Descriptors are rounded to single precision. Two distances are equal if they differ by less than :data:`ROUNDING`, and a
nearest neighbour with the same distance as the second nearest is no match.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from factorgraph_loc.errors import InputError
from factorgraph_loc.vision.keypoints import Descriptors, Integers
from factors.se2 import Array

RATIO = 0.8  # largest ratio of the distances of the nearest and the second nearest descriptor
GATE = 0.99  # probability that the true point lies in its gate
ROUNDING = 1e-5  # relative difference of distances below which they are equal

Truths = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Matches:
    """M matches between the descriptors of two images.

    ``indices`` (M, 2): indices of the descriptors in the first and in the second image, ascending in the first.
    ``distances`` (M,): distances of the descriptors.
    """

    indices: Integers
    distances: Array

    def __len__(self) -> int:
        return len(self.indices)


def match(
    first: Descriptors,
    second: Descriptors,
    *,
    ratio: float = RATIO,
    allowed: Truths | None = None,
) -> Matches:
    """Return the matches between the descriptors ``first`` (N, D) and the descriptors ``second`` (M, D).

    Two descriptors match if each is the nearest neighbour of the other. In addition their distance must be below
    ``ratio`` times the distance to the second nearest one in ``second``, if there is one. Ties are no matches.
    ``allowed`` (N, M): mask of the pairs that may match; None allows all. Raises InputError for incompatible or
    non-finite descriptors, and for a ratio that is not positive.
    """
    if not ratio > 0.0:
        raise InputError(f"matching: ratio is {ratio}, expected more than 0")
    distances = distance_matrix(first, second)
    if allowed is not None:
        if allowed.shape != distances.shape:
            raise InputError(f"matching: allowed has shape {allowed.shape}, expected {distances.shape}")
        distances[~allowed] = np.inf
    if distances.size == 0:
        return Matches(np.empty((0, 2), dtype=np.int64), np.empty(0))
    index, best, second = nearest_neighbours(distances)
    back, best_back, second_back = nearest_neighbours(distances.T)
    keep = np.isfinite(best) & _is_clear(best, second) & (best < ratio * second)
    keep &= (back[index] == np.arange(len(keep))) & _is_clear(best_back, second_back)[index]
    chosen = np.flatnonzero(keep)
    return Matches(np.stack([chosen, index[chosen]], axis=1), best[chosen])


def gates(predicted: Array, covariances: Array, points: Array) -> Truths:
    """Return a mask (N, M) that is True if a measured pixel lies in the gate of a predicted pixel.

    A gate is the ellipse that contains the measured pixel with the probability :data:`GATE`. The mask can be passed to
    :func:`match` as ``allowed``. ``predicted`` (N, 2) [px]: predicted pixels. ``covariances`` (N, 2, 2) [px^2]: of the
    difference between predicted and measured pixel. ``points`` (M, 2) [px]: measured pixels. The gate of a prediction
    that is NaN is empty. Raises InputError if a covariance is not positive definite.
    """
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    determinant = a * c - b * b
    finite = np.isfinite(predicted).all(axis=1)
    if len(bad := np.flatnonzero(finite & ~((a > 0.0) & (determinant > 0.0)))):
        raise InputError(f"matching: covariance {bad[0]} is {covariances[bad[0]].tolist()}, expected positive definite")
    dx, dy = (points[None, :, axis] - predicted[:, axis, None] for axis in (0, 1))
    scaled = c[:, None] * dx * dx - 2.0 * b[:, None] * dx * dy + a[:, None] * dy * dy
    # quantile of the chi-squared distribution with two degrees of freedom
    return np.asarray(scaled <= -2.0 * math.log1p(-GATE) * determinant[:, None])


def nearest_neighbours(distances: Array) -> tuple[Integers, Array, Array]:
    """Return three arrays (N,) for the rows of ``distances`` (N, M), M > 0: the index of the smallest distance, the
    smallest distance, and the second smallest distance, which is infinite if M is 1."""
    rows = np.arange(len(distances))
    index = distances.argmin(axis=1)
    best = distances[rows, index]
    distances[rows, index] = np.inf
    second = distances.min(axis=1)
    distances[rows, index] = best
    return index, best, second


def _is_clear(best: Array, second: Array) -> Truths:
    """Return a mask (N,) of the nearest neighbours that are nearer than the second nearest by more than rounding
    errors. ``best``, ``second`` (N,): the distances of the nearest and of the second nearest neighbour."""
    return np.asarray(second > (1.0 + ROUNDING) * best)


def distance_matrix(first: Descriptors, second: Descriptors) -> Array:
    """Return the distances (N, M) between the descriptors ``first`` (N, D) and ``second`` (M, D).

    These are Hamming distances of bits if the descriptors have the type ``uint8``, otherwise Euclidean distances.
    Raises InputError for incompatible or non-finite descriptors.
    """
    for which, descriptors in (("first", first), ("second", second)):
        if descriptors.ndim != 2:
            raise InputError(f"matching: {which} descriptors have shape {descriptors.shape}, expected (N, D)")
        if not np.isfinite(descriptors).all():
            raise InputError(f"matching: {which} descriptors have values that are not finite numbers")
    if first.shape[1] != second.shape[1]:
        raise InputError(
            f"matching: descriptors have {first.shape[1]} and {second.shape[1]} columns, expected equal numbers"
        )
    if (first.dtype == np.uint8) != (second.dtype == np.uint8):
        raise InputError(
            f"matching: descriptors are {first.dtype} and {second.dtype}, expected uint8 for both or for none"
        )
    if first.dtype != np.uint8:
        return np.asarray(cdist(first, second))
    left, right = (np.unpackbits(part, axis=1).astype(np.float32) for part in (first, second))
    differing = left.sum(axis=1)[:, None] + right.sum(axis=1) - 2.0 * left @ right.T
    return np.asarray(differing, dtype=float)
