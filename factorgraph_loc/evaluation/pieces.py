"""Pieces of a path over which relative errors are taken."""

import bisect
import itertools
from collections.abc import Iterable

import numpy as np

from factors.se2 import Array, Integers

TOLERANCE = 0.1  # by which the length of one of all pairs may differ, as a share of it


def successive(steps: Array, length: float, first: int = 0) -> list[tuple[int, int]]:
    """Pieces, one after the other, as indices of first and last pose, for the ``steps`` (N - 1,) between N poses that are numbered
    from ``first``: each ends at the first pose at which the steps since its beginning sum up to ``length`` or more."""
    found: list[tuple[int, int]] = []
    begin, covered = first, 0.0
    for i, step in enumerate(steps.tolist(), start=first + 1):
        covered += step
        if covered >= length:
            found.append((begin, i))
            begin, covered = i, 0.0
    return found


def all_pairs(steps: Array, length: float, first: int = 0) -> list[tuple[int, int]]:
    """The same for pieces that may overlap: from each pose to that later one whose distance is nearest to ``length``, the first of
    several, if it differs from that by at most :data:`TOLERANCE` of it."""
    covered = np.concatenate(([0.0], np.cumsum(steps))).tolist()
    found: list[tuple[int, int]] = []
    for i, here in enumerate(covered[:-1]):
        after = bisect.bisect_left(covered, here + length, i + 1)
        near = [j for j in (after - 1, after) if i < j < len(covered)]
        best = min(near, key=lambda j: abs(covered[j] - here - length))
        best = bisect.bisect_left(covered, covered[best], i + 1)  # the first of those that stand still
        if abs(covered[best] - here - length) <= TOLERANCE * length:
            found.append((first + i, first + best))
    return found


def between(count: int, breaks: Iterable[int]) -> list[tuple[int, int]]:
    """The half-open ranges of ``count`` indices that are split before each of ``breaks``."""
    bounds = [0, *sorted({b for b in breaks if 0 < b < count}), count]
    return list(itertools.pairwise(bounds))


def indices(pieces: list[tuple[int, int]]) -> tuple[Integers, Integers]:
    """First and last poses (K,) of ``pieces``."""
    begins, ends = np.array(pieces, dtype=np.int64).reshape(-1, 2).T
    return begins, ends
