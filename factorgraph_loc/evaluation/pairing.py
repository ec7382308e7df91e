"""Pairing of estimates and reference poses, at the reference's own stamps, at most ten per second.

The estimate is interpolated, the reference never is: it is defined at its stamps only, and a gap contains no stamp. Estimates are
on a grid of 10 Hz, so a scored pose is interpolated between two that are less than 0.1 s away; the later of them may use a
measurement that had not arrived at the stamp.

Poses are interpolated along the arc between neighbours. Covariances are averaged with the same weights: for errors ``a`` and
``b`` of the neighbours, the covariance of ``(1 - f) a + f b`` is at most ``(1 - f) E[a a'] + f E[b b']``, for any correlation,
and equal for identical errors.
"""

import bisect
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.trajectory3 import Trajectory3
from factors.se2 import Array, Integers

RATE = 10.0  # Hz, of poses that are scored
TOLERANCE = 1e-3  # s, of stamps
_PAUSE = 1.0  # s between neighbours of a reference that is never a gap
_USUAL = 3.0  # times the median interval that is never a gap


@dataclass(frozen=True)
class Pairs:
    """M estimates and true poses at the times ``t`` (M,), stamps of the reference from the first estimate to the last.

    ``poses`` (M, 3) and ``covariances`` (M, 3, 3) or None: of the estimate, NaN in its gaps. ``truth`` (M, 3).
    """

    t: Array
    poses: Array
    covariances: Array | None
    truth: Array


def thinned(t: Array) -> Integers:
    """Which of the stamps ``t`` (N,), ascending, are scored: the first, and each at least 0.1 s after the previous one."""
    kept: list[int] = []
    stamps, i = t.tolist(), 0
    while i < len(stamps):
        kept.append(i)
        i = max(i + 1, bisect.bisect_left(stamps, stamps[i] + 1.0 / RATE - TOLERANCE, i))
    return np.array(kept, dtype=np.int64)


def pairs(trajectory: Trajectory, reference: Trajectory, max_gap: float = MAX_GAP) -> Pairs:
    """The estimates at the reference's stamps, where neighbouring estimates are at most ``max_gap`` [s] apart."""
    rows = thinned(reference.t)
    at = _within(reference.t[rows], trajectory.t)
    rows, at = rows[np.isfinite(at)], at[np.isfinite(at)]
    covariances = None if trajectory.covariances is None else trajectory.covariances_at(at, max_gap=max_gap)
    return Pairs(reference.t[rows], trajectory.at(at, max_gap=max_gap), covariances, reference.poses[rows])


def pairs_in_space(
    found: Trajectory3, reference: Trajectory3, max_gap: float = MAX_GAP
) -> tuple[Trajectory3, Trajectory3]:
    """The same in space: estimates with covariances, and true poses; only where both exist."""
    rows = thinned(reference.t)
    at = _within(reference.t[rows], found.t)
    valid = found.spans(at, max_gap=max_gap)
    return found.at(at[valid]), reference.rows(rows[valid])


def pauses(t: Array) -> Integers:
    """The stamps ``t`` (N,) that follow a gap: more than 1 s, and more than three times the median interval."""
    if len(t) < 2:
        return np.empty(0, dtype=np.int64)
    steps = np.diff(t)
    return np.flatnonzero(steps > max(_PAUSE, _USUAL * float(np.median(steps)))) + 1


def _within(t: Array, stamps: Array) -> Array:
    """Times ``t`` clipped to the range of ``stamps`` if outside by at most the tolerance, else NaN."""
    if not len(stamps):
        return np.full(len(t), np.nan)
    clipped = np.clip(t, stamps[0], stamps[-1])
    return np.asarray(np.where(np.abs(clipped - t) <= TOLERANCE, clipped, np.nan))
