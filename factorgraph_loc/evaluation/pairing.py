"""Which poses are compared with the reference: those at its own stamps, at most ten a second.

The estimate is interpolated, the reference never is: whoever measured it says where the robot was at its stamps and nowhere else,
and a gap of it holds no stamp. Estimates stand on a grid of 10 Hz, so the one that is scored lies between two that are less than
0.1 s away; the later of them may know a measurement that the robot did not yet have at the stamp.

Poses go along the arc between neighbours. Covariances are averaged, weighted as the poses are: for errors ``a`` and ``b`` of the
neighbours, the error ``(1 - f) a + f b`` has no greater covariance than ``(1 - f) E[a a'] + f E[b b']``, however they are
correlated, and just this one where both are the same.
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
_PAUSE = 1.0  # s between neighbours of a reference that are no pause, however dense it is elsewhere
_USUAL = 3.0  # times the usual distance in time: neighbours that far apart are no pause either


@dataclass(frozen=True)
class Pairs:
    """M estimates and true poses at the times ``t`` (M,), stamps of the reference from the first estimate to the last.

    ``poses`` (M, 3) and ``covariances`` (M, 3, 3), if there are any: of the estimate, NaN in its gaps. ``truth`` (M, 3).
    """

    t: Array
    poses: Array
    covariances: Array | None
    truth: Array


def thinned(t: Array) -> Integers:
    """Which of the stamps ``t`` (N,), ascending, are scored: the first, and each that comes 0.1 s or more after the one before."""
    kept: list[int] = []
    stamps, i = t.tolist(), 0
    while i < len(stamps):
        kept.append(i)
        i = max(i + 1, bisect.bisect_left(stamps, stamps[i] + 1.0 / RATE - TOLERANCE, i))
    return np.array(kept, dtype=np.int64)


def pairs(trajectory: Trajectory, reference: Trajectory, max_gap: float = MAX_GAP) -> Pairs:
    """The estimates at the reference's stamps, where the trajectory's neighbours lie at most ``max_gap`` [s] apart."""
    rows = thinned(reference.t)
    at = _within(reference.t[rows], trajectory.t)
    rows, at = rows[np.isfinite(at)], at[np.isfinite(at)]
    covariances = None if trajectory.covariances is None else trajectory.covariances_at(at, max_gap=max_gap)
    return Pairs(reference.t[rows], trajectory.at(at, max_gap=max_gap), covariances, reference.poses[rows])


def pairs_in_space(
    found: Trajectory3, reference: Trajectory3, max_gap: float = MAX_GAP
) -> tuple[Trajectory3, Trajectory3]:
    """The same in space: estimates with their covariances, and true poses; only those that have both."""
    rows = thinned(reference.t)
    at = _within(reference.t[rows], found.t)
    valid = found.spans(at, max_gap=max_gap)
    return found.at(at[valid]), reference.rows(rows[valid])


def pauses(t: Array) -> Integers:
    """Before which of the stamps ``t`` (N,) there is a pause: of more than 1 s, and more than three times the usual time."""
    if len(t) < 2:
        return np.empty(0, dtype=np.int64)
    steps = np.diff(t)
    return np.flatnonzero(steps > max(_PAUSE, _USUAL * float(np.median(steps)))) + 1


def _within(t: Array, stamps: Array) -> Array:
    """Times ``t``, those that lie outside ``stamps`` by no more than the tolerance moved to its first or last, others made NaN."""
    if not len(stamps):
        return np.full(len(t), np.nan)
    clipped = np.clip(t, stamps[0], stamps[-1])
    return np.asarray(np.where(np.abs(clipped - t) <= TOLERANCE, clipped, np.nan))
