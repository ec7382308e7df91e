"""Common steps of all scores of trajectories: pairing with the reference, alignment in the plane, pieces, statistics of errors.

Estimates are paired with the reference at its own stamps, at most ten per second. Pieces are intervals of relative errors.

Estimates are interpolated. The reference is not: it is defined only at its stamps, and a gap contains no stamp. Estimates are on
a grid of 10 Hz, so a scored pose is interpolated between two that are less than 0.1 s away. The later of these may use a
measurement that had not arrived at the stamp.

Poses are interpolated along the arc between neighbours. Covariances are averaged with the same weights. Let ``a`` and ``b`` be
the errors of the neighbours. The covariance of ``(1 - f) a + f b`` is at most ``(1 - f) E[a a'] + f E[b b']``, for any
correlation. Both are equal for identical errors.
"""

import bisect
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.files import checks
from factorgraph_loc.model.pose_path import PosePath
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.model.trajectory import Trajectory, neighbours
from factors.se2 import Array, Integers

RATE = 10.0  # Hz, of poses that are scored
TOLERANCE = 1e-3  # s, of stamps
_PAUSE = 1.0  # s between neighbours of a reference that is never a gap
_USUAL = 3.0  # times the median interval that is never a gap
PIECE_TOLERANCE = 0.1  # maximum relative difference of a length, for all pairs of poses
DELTA = 1.0  # m, and s: interval of relative errors
CONFIDENCE = 0.95  # of intervals
HOW = ("rmse", "mean", "median", "p95", "max", "min", "std")


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


def pairs_in_space(estimate: PosePath, reference: PosePath, max_gap: float = MAX_GAP) -> tuple[PosePath, PosePath]:
    """The same in space: estimates and true poses, only where both exist."""
    t0_ns = int(estimate.stamps()[0])
    own, t = (checks.seconds(path.stamps(), t0_ns) for path in (estimate, reference))
    rows = thinned(t)
    at = _within(t[rows], own)
    *_, valid = neighbours(own, at, max_gap)
    return estimate.at(checks.absolute(at[valid], t0_ns)), reference.rows(rows[valid])


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


def rms(values: Array) -> float | None:
    """Root mean square of the finite values, None without any."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def summarize(values: Array) -> dict[str, float | None]:
    """Statistics of the finite values by the names of :data:`HOW`, None without any."""
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
    """Successive pieces as indices of their first and last pose.

    ``steps`` (N - 1,): between N poses, numbered from ``first``. A piece ends at the first pose where its steps sum up to
    ``length`` or more.
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
    """The same for pieces that may overlap: from each pose to the first later one with a distance nearest to ``length``.

    Pieces that differ from ``length`` by more than :data:`PIECE_TOLERANCE` of it are omitted.
    """
    covered = np.concatenate(([0.0], np.cumsum(steps))).tolist()
    pieces: list[tuple[int, int]] = []
    for i, start in enumerate(covered[:-1]):
        next_index = bisect.bisect_left(covered, start + length, i + 1)
        near = [j for j in (next_index - 1, next_index) if i < j < len(covered)]
        best = min(near, key=lambda j: abs(covered[j] - start - length))
        best = bisect.bisect_left(covered, covered[best], i + 1)  # the first pose of a stop
        if abs(covered[best] - start - length) <= PIECE_TOLERANCE * length:
            pieces.append((first + i, first + best))
    return pieces
