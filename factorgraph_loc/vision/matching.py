"""Which descriptors of two images belong together: nearest neighbours that are clearly nearer than the second nearest.

Ratio test and mutual check: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 60, 2004, section
7.1. The paper accepts a match "if distance is less than 5 times the distance to the second closest", which always
holds: ``paper_literal`` does so, and ``ratio=1 / PAPER_RATIO, mutual=False`` is the strict sense in which it may have
been meant."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.vision.colour import Float
from factorgraph_loc.vision.keypoints import Descriptors, Integers
from factors.se2 import Array

RATIO = 0.8
PAPER_RATIO = 5.0
GATE = 0.99  # probability that the true point lies in its gate

Truths = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Matches:
    """``indices`` (M, 2): of the descriptor in the first and in the second image, ascending in the first;
    ``distances`` (M,)."""

    indices: Integers
    distances: Array

    def __len__(self) -> int:
        return len(self.indices)


def match(
    first: Descriptors,
    second: Descriptors,
    *,
    binary: bool,
    ratio: float = RATIO,
    mutual: bool = True,
    paper_literal: bool = False,
    allowed: Truths | None = None,
) -> Matches:
    """For each of ``first`` (N, D) the nearest of ``second`` (M, D), if its distance is below ``ratio`` times that to
    the second nearest; one without a second nearest passes.

    ``binary``: Hamming distance, not Euclidean. ``mutual``: both must be nearest to each other. ``paper_literal``:
    the paper's ratio of 5, without the mutual check. ``allowed`` (N, M): only such pairs are looked at. InputError
    for descriptors that are not alike, or not finite, and for a ratio that is not above 0."""
    if paper_literal:
        ratio, mutual = PAPER_RATIO, False
    if not ratio > 0.0:
        raise InputError(f"matching: ratio is {ratio}, expected more than 0")
    distances = distance_matrix(first, second, binary=binary)
    if allowed is not None:
        if allowed.shape != distances.shape:
            raise InputError(f"matching: allowed pairs have shape {allowed.shape}, expected {distances.shape}")
        distances[~allowed] = np.inf
    if distances.size == 0:
        return Matches(np.empty((0, 2), dtype=np.int64), np.empty(0))
    rows = np.arange(len(distances))
    nearest = distances.argmin(axis=1)
    best = distances[rows, nearest]
    keep = np.isfinite(best)
    if mutual:
        keep &= distances.argmin(axis=0)[nearest] == rows
    distances[rows, nearest] = np.inf
    keep &= best < ratio * distances.min(axis=1)
    chosen = np.flatnonzero(keep)
    return Matches(np.stack([chosen, nearest[chosen]], axis=1), best[chosen].astype(float))


def match_guided(
    first: Descriptors,
    second: Descriptors,
    predicted: Array,
    covariances: Array,
    points: Array,
    *,
    binary: bool,
    ratio: float = RATIO,
    mutual: bool = True,
    probability: float = GATE,
) -> Matches:
    """:func:`match` of ``first`` (N, D), predicted to be seen at ``predicted`` (N, 2) [px] with ``covariances`` (N,
    2, 2) [px^2] of prediction and measurement together, with ``second`` (M, D) at ``points`` (M, 2): only inside the
    :func:`gates`."""
    allowed = gates(predicted, covariances, points, probability)
    return match(first, second, binary=binary, ratio=ratio, mutual=mutual, allowed=allowed)


def gates(predicted: Array, covariances: Array, points: Array, probability: float = GATE) -> Truths:
    """Which of ``points`` (M, 2) lie in the ellipses (N, M) that hold a Gaussian's ``probability``, of means
    ``predicted`` (N, 2) and ``covariances`` (N, 2, 2). What is predicted as NaN has an empty gate; InputError if a
    covariance is not positive definite."""
    if not 0.0 < probability < 1.0:
        raise InputError(f"matching: probability of a gate is {probability}, expected between 0 and 1")
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    determinant = a * c - b * b
    seen = np.isfinite(predicted).all(axis=1)
    if len(bad := np.flatnonzero(seen & ~((a > 0.0) & (determinant > 0.0)))):
        raise InputError(f"matching: covariance {bad[0]} is {covariances[bad[0]].tolist()}, expected positive definite")
    dx, dy = (points[None, :, axis] - predicted[:, axis, None] for axis in (0, 1))
    scaled = c[:, None] * dx * dx - 2.0 * b[:, None] * dx * dy + a[:, None] * dy * dy
    # of two degrees of freedom the chi-squared distribution has this quantile
    return np.asarray(scaled <= -2.0 * math.log1p(-probability) * determinant[:, None])


def distance_matrix(first: Descriptors, second: Descriptors, *, binary: bool) -> Float:
    """Distances (N, M) between ``first`` (N, D) and ``second`` (M, D): the number of bits that differ, or Euclidean.
    InputError for descriptors that are not alike, or not finite."""
    for which, descriptors in (("first", first), ("second", second)):
        if descriptors.ndim != 2 or (binary and descriptors.dtype != np.uint8):
            kind = f"{descriptors.dtype} of shape {descriptors.shape}"
            raise InputError(
                f"matching: {which} descriptors are {kind}, expected {'uint8 of ' if binary else ''}(N, D)"
            )
        if not binary and not np.isfinite(descriptors).all():
            raise InputError(f"matching: {which} descriptors have values that are not finite numbers")
    if first.shape[1] != second.shape[1]:
        raise InputError(f"matching: descriptors have {first.shape[1]} and {second.shape[1]} columns, expected as many")
    if binary:
        first, second = np.unpackbits(first, axis=1), np.unpackbits(second, axis=1)
    left, right = first.astype(np.float32), second.astype(np.float32)
    squared = -2.0 * left @ right.T
    squared += np.einsum("nd,nd->n", left, left)[:, None]
    squared += np.einsum("md,md->m", right, right)
    # of bits the square is the number of those that differ
    return np.maximum(squared, 0.0) if binary else np.sqrt(np.maximum(squared, 0.0))
