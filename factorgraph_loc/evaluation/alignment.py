"""Scores of a run that estimated its map: its frame is arbitrary, so the estimate is aligned with the reference first.

Alignment: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991, equations 40 to 42
with scale 1. In the plane the rotation is one angle, and reflections cannot occur.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from factorgraph_loc.evaluation.pairing import pairs
from factorgraph_loc.model.belief import LearntPoint
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.model.trajectory import Trajectory
from factors import positive, se2
from factors.se2 import Array

FIGURES = ("aligned.position_rmse", "aligned.heading_rmse", "landmarks.count", "landmarks.rmse", "landmarks.anees")


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
