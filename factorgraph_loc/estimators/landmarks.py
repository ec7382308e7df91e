"""Identified landmarks of the known map, as all estimators take them in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_loc.estimators.base import Diagnostics
from factorgraph_loc.estimators.registry import Setup
from factorgraph_loc.measurements import BearingRange
from factors import se2
from factors.bearing_range import BearingRangeFactor, cauchy_weight
from factors.odometry import Increment
from factors.se2 import Array

CONVERGED = 1e-6  # of an iterated update, m and rad
GATE = 9.21  # 99 % of chi-square with two degrees of freedom


class KnownLandmarks:
    """Turns measurements into factors on a pose; what the map or the rig lacks is counted as ignored."""

    def __init__(self, setup: Setup, diagnostics: Diagnostics) -> None:
        settings = setup.rig.bearing_range if "bearing_range" in setup.sensors else None
        self._model = None if settings is None else settings.model()
        self._positions = {name: np.array((m.x, m.y)) for name, m in setup.world.landmarks.items()}
        self._diagnostics = diagnostics

    def factor(self, m: BearingRange, offset: Increment | None = None) -> BearingRangeFactor | None:
        """The factor of a measurement, on the pose at its time, or on the one that lies ``offset`` before it."""
        if self._model is None:
            self._diagnostics.ignore("bearing_range", len(m.landmarks))
            return None
        rows = [i for i, name in enumerate(m.landmarks) if name in self._positions and _has_value(m, i)]
        if len(rows) < len(m.landmarks):
            self._diagnostics.ignore("landmark not in the map", len(m.landmarks) - len(rows))
        if not rows:
            return None
        points = np.array([self._positions[m.landmarks[i]] for i in rows])
        ranges, bearings = m.range[rows], m.bearing[rows]
        if offset is None:
            return BearingRangeFactor(self._model, points, ranges, bearings)
        return BearingRangeFactor(self._model, points, ranges, bearings, offset.delta, offset.covariance)

    def report(self, t: float, factor: BearingRangeFactor, innovation: Innovation) -> None:
        """Record the normalised innovation squared, over the values that were measured."""
        used = np.column_stack((~np.isnan(factor.ranges), ~np.isnan(factor.bearings))).ravel()
        e, s = innovation.error[used], innovation.covariance[np.ix_(used, used)]
        self._diagnostics.innovation("bearing_range", t, float(e @ np.linalg.solve(s, e)), len(e))


@dataclass(frozen=True)
class Innovation:
    """Whitened measurement less prediction (2K,), and its covariance (2K, 2K) under prediction and noise."""

    error: Array
    covariance: Array


def robust_update(
    factor: BearingRangeFactor, pose: Array, covariance: Array, iterations: int
) -> tuple[Array, Array, Innovation]:
    """Kalman update of ``pose`` (3,) and further states, robust and iterated.

    ``covariance`` (S, S): of the error state, whose first three components are the pose's body-frame perturbation. At first a
    landmark whose normalised innovation squared lies beyond the gate has its noise widened by the square of the excess, so that
    it pulls the less the farther off it is, but never locks the filter out. Further iterations widen it by the inverse of its
    Cauchy weight at the updated pose (iteratively reweighted least squares).
    Returns the correction (S,), the updated covariance and the innovation at the prediction.
    """
    size = len(covariance)
    delta = np.zeros(size)
    for iteration in range(iterations):
        residual, jacobian = factor.whitened(pose if iteration == 0 else se2.compose(pose, se2.exp(delta[:3])))
        h = np.zeros((residual.size, size))
        h[:, :3] = jacobian.reshape(-1, 3)
        spread = h @ covariance @ h.T
        error = h @ delta - residual.ravel()
        if iteration == 0:
            first = Innovation(error, spread + np.eye(len(error)))
            widening = np.maximum(1.0, _per_landmark(first) / GATE) ** 2
        else:
            widening = 1.0 / cauchy_weight(np.sum(residual**2, axis=-1), factor.model.robust)
        noise = np.repeat(widening, 2)
        gain = np.linalg.solve(spread + np.diag(noise), h @ covariance).T
        step = gain @ error
        settled = np.abs(step - delta).max() < CONVERGED
        delta = step
        if settled:
            break
    keep = np.eye(size) - gain @ h
    updated = keep @ covariance @ keep.T + (gain * noise) @ gain.T
    return delta, (updated + updated.T) / 2.0, first


def _per_landmark(innovation: Innovation) -> Array:
    """Normalised innovation squared (K,) of each landmark by itself."""
    count = len(innovation.error) // 2
    i = np.arange(count)
    blocks = innovation.covariance.reshape(count, 2, count, 2)[i, :, i, :]
    e = innovation.error.reshape(count, 2)
    return np.asarray(np.sum(e * np.linalg.solve(blocks, e[:, :, None])[:, :, 0], axis=-1))


def _has_value(m: BearingRange, i: int) -> bool:
    return not (np.isnan(m.range[i]) and np.isnan(m.bearing[i]))
