"""Common steps of all scores of trajectories: pairing with the reference, pieces of paths, and statistics of errors.

A trajectory is compared with the reference at timestamps of the reference, at most ten per second. The estimates are
interpolated at these timestamps, and nothing is scored in gaps of the reference. An interpolated estimate may use a
measurement that arrives shortly after the timestamp, because estimates are usually 0.1 s apart.

Poses are interpolated along the arc between neighbours. Covariances are averaged with the same weights. This is
conservative: the weighted mean of two errors never has a larger covariance, for any correlation of the errors.
"""

import bisect
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.files import checks
from factorgraph_loc.model.pose_path import PosePath
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.model.trajectory import Trajectory, neighbours
from factors.se2 import Array, Integers

RATE = 10.0  # Hz; maximum rate of scored poses
TOLERANCE = 1e-3  # s; tolerance of comparisons of timestamps
_PAUSE = 1.0  # s; a shorter interval between timestamps is no gap
_USUAL = 3.0  # an interval below this multiple of the median interval is no gap
PIECE_TOLERANCE = 0.1  # maximum relative deviation of a piece's length from the requested length
DELTA = 1.0  # relative errors are over pieces of this many metres of path, and of this many seconds
CONFIDENCE = 0.95  # probability of all intervals
HOW = ("rmse", "mean", "median", "p95", "max", "min", "std")  # names of statistics


@dataclass(frozen=True)
class Pairs:
    """Estimated and true poses (x, y, heading) at M timestamps of the reference.

    ``t`` (M,): times [s] between the first and the last estimate. ``truth`` (M, 3): poses of the reference.
    ``poses`` (M, 3), ``covariances`` (M, 3, 3) or None: interpolated estimates, NaN in gaps of the estimates.
    """

    t: Array
    poses: Array
    covariances: Array | None
    truth: Array


def thinned(t: Array) -> Integers:
    """Return the indices of the timestamps ``t`` (N,) [s], ascending, that are selected for scoring poses. The first
    timestamp is selected, and then each one at least 0.1 s after the last selected one."""
    kept: list[int] = []
    stamps, i = t.tolist(), 0
    while i < len(stamps):
        kept.append(i)
        i = max(i + 1, bisect.bisect_left(stamps, stamps[i] + 1.0 / RATE - TOLERANCE, i))
    return np.array(kept, dtype=np.int64)


def pairs(trajectory: Trajectory, reference: Trajectory, max_gap: float = MAX_GAP) -> Pairs:
    """Return the poses of a trajectory, interpolated at timestamps of the reference, and the poses of the reference.

    ``max_gap`` [s]: the interpolated pose is NaN between estimates that are further apart.
    """
    rows = thinned(reference.t)
    at = _within(reference.t[rows], trajectory.t)
    rows, at = rows[np.isfinite(at)], at[np.isfinite(at)]
    covariances = None if trajectory.covariances is None else trajectory.covariances_at(at, max_gap=max_gap)
    return Pairs(reference.t[rows], trajectory.at(at, max_gap=max_gap), covariances, reference.poses[rows])


def pairs_in_space(estimate: PosePath, reference: PosePath, max_gap: float = MAX_GAP) -> tuple[PosePath, PosePath]:
    """Return M poses of ``estimate``, interpolated at timestamps of the reference, and the M poses of the reference.

    ``max_gap`` [s]: timestamps between estimates that are further apart are omitted.
    """
    t0_ns = int(estimate.stamps()[0])
    own, t = (checks.seconds(path.stamps(), t0_ns) for path in (estimate, reference))
    rows = thinned(t)
    at = _within(t[rows], own)
    *_, valid = neighbours(own, at, max_gap)
    return estimate.at(checks.absolute(at[valid], t0_ns)), reference.rows(rows[valid])


def pauses(t: Array) -> Integers:
    """Return the indices of the timestamps ``t`` (N,) [s] that follow a gap.

    A gap is an interval between timestamps that is longer than 1 s and than three times the median interval.
    """
    if len(t) < 2:
        return np.empty(0, dtype=np.int64)
    steps = np.diff(t)
    return np.flatnonzero(steps > max(_PAUSE, _USUAL * float(np.median(steps)))) + 1


def _within(t: Array, stamps: Array) -> Array:
    """Return the times ``t`` (M,) clipped to the range of the timestamps ``stamps`` (N,). A time that is outside by
    more than :data:`TOLERANCE` becomes NaN."""
    if not len(stamps):
        return np.full(len(t), np.nan)
    clipped = np.clip(t, stamps[0], stamps[-1])
    return np.asarray(np.where(np.abs(clipped - t) <= TOLERANCE, clipped, np.nan))


def rms(values: Array) -> float | None:
    """Return the root mean square of the finite values, or None if there are none."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def summarize(values: Array) -> dict[str, float | None]:
    """Return the statistics of the finite ``values`` as {name: value}: rmse, mean, median, p95, max, min and std. All
    are None if there are no finite values."""
    values = values[np.isfinite(values)]
    if not len(values):
        return dict.fromkeys(HOW)
    return {
        "rmse": rms(values),
        "mean": float(np.mean(values)),
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
        "max": float(np.max(values)),
        "min": float(np.min(values)),
        "std": float(np.std(values)),
    }


def successive(steps: Array, length: float, first: int = 0) -> list[tuple[int, int]]:
    """Return (index of the first pose, index of the last pose) of successive sections of a path of N poses.

    ``steps`` (N - 1,): distances or times between successive poses. A section ends at the first pose where the sum of
    its steps is ``length`` or more. ``first``: an offset that is added to all indices.
    """
    pieces: list[tuple[int, int]] = []
    begin, covered = first, 0.0
    for i, step in enumerate(steps.tolist(), start=first + 1):
        covered += step
        if covered >= length:
            pieces.append((begin, i))
            begin, covered = i, 0.0
    return pieces


def all_pairs(steps: Array, length: float, first: int = 0) -> list[tuple[int, int]]:
    """Return (index of the first pose, index of the last pose) of overlapping sections of a path of N poses.

    ``steps`` (N - 1,): distances or times between successive poses. A section begins at each pose, and the sum of its
    steps is as near to ``length`` as possible. It is omitted if the sum deviates by more than :data:`PIECE_TOLERANCE`
    times ``length``. ``first``: an offset that is added to all indices.
    """
    covered = np.concatenate(([0.0], np.cumsum(steps))).tolist()
    pieces: list[tuple[int, int]] = []
    for i, start in enumerate(covered[:-1]):
        next_index = bisect.bisect_left(covered, start + length, i + 1)
        near = [j for j in (next_index - 1, next_index) if i < j < len(covered)]
        best = min(near, key=lambda j: abs(covered[j] - start - length))
        best = bisect.bisect_left(covered, covered[best], i + 1)  # the first of several poses at this distance
        if abs(covered[best] - start - length) <= PIECE_TOLERANCE * length:
            pieces.append((first + i, first + best))
    return pieces
