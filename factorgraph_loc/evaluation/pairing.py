"""Pairing of estimates and reference poses, at the reference's own stamps, at most ten per second; and scores of a run that
estimated its map: its frame is arbitrary, so the estimate is aligned with the reference first.

The estimate is interpolated, the reference never is: it is defined at its stamps only, and a gap contains no stamp. Estimates are
on a grid of 10 Hz, so a scored pose is interpolated between two that are less than 0.1 s away; the later of them may use a
measurement that had not arrived at the stamp.

Poses are interpolated along the arc between neighbours. Covariances are averaged with the same weights: for errors ``a`` and
``b`` of the neighbours, the covariance of ``(1 - f) a + f b`` is at most ``(1 - f) E[a a'] + f E[b b']``, for any correlation,
and equal for identical errors.

Alignment: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991, equations 40 to 42
with scale 1. In the plane the rotation is one angle, and reflections cannot occur.
"""

import bisect
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgraph_loc.model.belief import LearntPoint
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.trajectory3 import Trajectory3
from factors import positive, se2
from factors.se2 import Array, Integers

RATE = 10.0  # Hz, of poses that are scored
TOLERANCE = 1e-3  # s, of stamps
_PAUSE = 1.0  # s between neighbours of a reference that is never a gap
_USUAL = 3.0  # times the median interval that is never a gap
FIGURES = ("aligned.position_rmse", "aligned.heading_rmse", "landmarks.count", "landmarks.rmse", "landmarks.anees")


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
    """The same in space: estimates and true poses, only where both exist."""
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


def align(trajectory: Trajectory, reference: Trajectory, max_gap: float = MAX_GAP) -> Array:
    """The pose (3,) of the estimate's frame in the reference's, by least squares on the positions at the scored stamps; NaN if
    there are none."""
    pair = pairs(trajectory, reference, max_gap)
    return align_points(pair.poses[:, :2], pair.truth[:, :2])


def align_points(points: Array, targets: Array) -> Array:
    """The pose (3,) that moves ``points`` (N, 2) onto ``targets`` (N, 2) in least squares; pairs with a NaN are ignored.

    NaN without a pair. For coincident points the rotation is 0.
    """
    known = np.isfinite(points).all(axis=1) & np.isfinite(targets).all(axis=1)
    if not known.any():
        return np.full(3, np.nan)
    centre, target_centre = points[known].mean(axis=0), targets[known].mean(axis=0)
    a, b = points[known] - centre, targets[known] - target_centre
    angle = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    rotation = np.array((0.0, 0.0, angle))
    return np.array((*(target_centre - se2.transform_from(rotation, centre)), angle))


def free_map_figures(
    trajectory: Trajectory, landmarks: Mapping[str, LearntPoint], log: Log, max_gap: float = MAX_GAP
) -> dict[str, Any]:
    """``FIGURES`` of a run that estimated its map.

    ``aligned.*``: root mean square error of the aligned ``trajectory`` in position [m] and heading [rad]. ``landmarks.*``: of the
    learnt landmarks that are also in the log's map, after the same alignment: their ``count``, root mean square distance ``rmse``
    [m] and mean NEES ``anees``, ideally 2. The covariances include the uncertainty of the start, which the alignment removes, so
    less than 2 is usual. Without a reference the landmarks themselves are aligned. None where a figure is undefined.
    """
    figures: dict[str, Any] = dict.fromkeys(FIGURES)
    names = [name for name in landmarks if name in log.world.landmarks]
    figures["landmarks.count"] = len(names)
    positions = np.array([landmarks[name].position for name in names]).reshape(-1, 2)
    truth = np.array([log.world.position(name) for name in names]).reshape(-1, 2)
    if log.reference is None:
        pose = align_points(positions, truth)
    else:
        pair = pairs(trajectory, log.reference, max_gap)
        pose = align_points(pair.poses[:, :2], pair.truth[:, :2])
        error = se2.compose(pose, pair.poses) - pair.truth
        figures["aligned.position_rmse"] = rms(np.hypot(error[:, 0], error[:, 1]))
        if log.reference.has_heading:
            figures["aligned.heading_rmse"] = rms(se2.wrap(error[:, 2]))
    if names and np.isfinite(pose).all():
        # in the estimate's own frame, as the covariances
        error = positions - se2.transform_to(pose, truth)
        figures["landmarks.rmse"] = rms(np.hypot(error[:, 0], error[:, 1]))
        figures["landmarks.anees"] = _anees(error, np.array([landmarks[name].covariance for name in names]))
    return figures


def rms(values: Array) -> float | None:
    """Root mean square of the finite values, None without any."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def _anees(errors: Array, covariances: Array) -> float | None:
    """Mean NEES of errors (N, 2) with covariances (N, 2, 2), of those that are positive definite."""
    good = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    good[good] = np.linalg.eigvalsh(covariances[good])[:, 0] > 0.0
    if not good.any():
        return None
    whitened = positive.solve(covariances[good], errors[good, :, None])[..., 0]
    return float(np.mean(np.sum(errors[good] * whitened, axis=1)))
