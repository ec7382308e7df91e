"""Identified landmarks of the known map, as all estimators take them in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_loc.estimators.base import Diagnostics
from factorgraph_loc.estimators.registry import Setup
from factorgraph_loc.measurements import BearingRange
from factors import se2
from factors.bearing_range import BearingRangeFactor, robust_weight, sigmas
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
        known = [i for i, name in enumerate(m.landmarks) if name in self._positions]
        rows = [i for i in known if not (np.isnan(m.range[i]) and np.isnan(m.bearing[i]))]
        if len(known) < len(m.landmarks):
            self._diagnostics.ignore("landmark not in the map", len(m.landmarks) - len(known))
        if len(rows) < len(known):
            self._diagnostics.ignore("neither range nor bearing", len(known) - len(rows))
        if not rows:
            return None
        points = np.array([self._positions[m.landmarks[i]] for i in rows])
        ranges, bearings = m.range[rows], m.bearing[rows]
        if offset is None:
            return BearingRangeFactor(self._model, points, ranges, bearings)
        return BearingRangeFactor(self._model, points, ranges, bearings, offset.delta, offset.covariance)

    def report(self, t: float, factor: BearingRangeFactor, update: Update) -> None:
        """Record the innovation of an update at time ``t``."""
        self._diagnostics.innovation("bearing_range", t, update.nis, update.dof)
        errors = -update.residual * sigmas(factor.model, factor.ranges)
        for i, (name, measured) in enumerate((("range", factor.ranges), ("bearing", factor.bearings))):
            found = errors[~np.isnan(measured), i].tolist()
            self._diagnostics.residuals.setdefault(f"bearing_range.{name}", []).extend(found)


@dataclass(frozen=True)
class Update:
    """What a Kalman update gives: ``delta`` (S,) of the error state, its ``covariance`` (S, S) afterwards, and at the prediction
    the whitened ``residual`` (K, 2), predicted less measured, and its normalised square (``nis``) with degrees of freedom."""

    delta: Array
    covariance: Array
    residual: Array
    nis: float
    dof: int


def robust_update(factor: BearingRangeFactor, pose: Array, covariance: Array, iterations: int) -> Update:
    """Kalman update of ``pose`` (3,) and further states, robust and iterated, in information form.

    ``covariance`` (S, S): of the error state, whose first three components are the pose's body-frame perturbation. At first a
    landmark whose normalised innovation squared lies beyond the gate has its noise widened by the square of the excess, so that
    it pulls the less the farther off it is, but never locks the filter out. Further iterations widen it by the inverse of its
    robust weight at the updated pose (iteratively reweighted least squares).
    """
    prior: Array = np.asarray(np.linalg.inv(covariance), dtype=float)
    delta: Array = np.zeros(len(covariance))
    nis, first = 0.0, np.zeros((0, 2))
    for iteration in range(iterations):
        residual, blocks = factor.whitened(pose if iteration == 0 else se2.compose(pose, se2.exp(delta[:3])))
        jacobian = blocks.reshape(-1, 3)
        if iteration == 0:
            first = residual
            nis = _total(residual.ravel(), jacobian, prior)
            weight = np.maximum(1.0, _per_landmark(residual, blocks, covariance[:3, :3]) / GATE) ** -2
        else:
            weight = robust_weight(np.einsum("ki,ki->k", residual, residual), factor.model.robust)
        weighted = jacobian.T * np.repeat(weight, 2)
        information = prior.copy()
        information[:3, :3] += weighted @ jacobian
        updated = np.linalg.inv(information)
        step = updated[:, :3] @ (weighted @ (jacobian @ delta[:3] - residual.ravel()))
        settled = np.abs(step - delta).max() < CONVERGED
        delta = np.asarray(step, dtype=float)
        if settled:
            break
    dof = int(np.count_nonzero(~np.isnan(factor.ranges)) + np.count_nonzero(~np.isnan(factor.bearings)))
    return Update(delta, (updated + updated.T) / 2.0, first, nis, dof)


def _total(error: Array, jacobian: Array, prior: Array) -> float:
    """Normalised innovation squared of all landmarks together, by the matrix inversion lemma."""
    information = prior.copy()
    information[:3, :3] += jacobian.T @ jacobian
    pull = np.zeros(len(prior))
    pull[:3] = jacobian.T @ error
    return float(error @ error - pull @ np.linalg.solve(information, pull))


def _per_landmark(residual: Array, blocks: Array, covariance: Array) -> Array:
    """Normalised innovation squared (K,) of each landmark by itself."""
    s = blocks @ covariance @ blocks.transpose(0, 2, 1)
    a, b, c = s[:, 0, 0] + 1.0, s[:, 0, 1], s[:, 1, 1] + 1.0
    x, y = residual[:, 0], residual[:, 1]
    return np.asarray((c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b))
