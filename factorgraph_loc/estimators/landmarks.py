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
    prior = np.asarray(np.linalg.inv(covariance), dtype=float)
    residual, blocks = factor.whitened(pose)
    widening = np.maximum(1.0, _per_landmark(residual, blocks, covariance[:3, :3]) / GATE)
    delta, updated = _solve(prior, blocks, residual, np.ones(len(residual)), np.zeros(3))
    # by the matrix inversion lemma
    pull = np.einsum("kij,ki->j", blocks, residual)
    nis = float(np.vdot(residual, residual) - pull @ updated[:3, :3] @ pull)
    if widening.max() > 1.0:
        delta, updated = _solve(prior, blocks, residual, widening**-2, np.zeros(3))
    first = residual
    for _ in range(iterations - 1):
        residual, blocks = factor.whitened(se2.compose(pose, se2.exp(delta[:3])))
        weight = robust_weight(np.einsum("ki,ki->k", residual, residual), factor.model.robust)
        before = delta
        delta, updated = _solve(prior, blocks, residual, weight, delta[:3])
        if np.abs(delta - before).max() < CONVERGED:
            break
    dof = int(np.count_nonzero(~np.isnan(factor.ranges)) + np.count_nonzero(~np.isnan(factor.bearings)))
    return Update(delta, (updated + updated.T) / 2.0, first, nis, dof)


def _solve(prior: Array, blocks: Array, residual: Array, weight: Array, at: Array) -> tuple[Array, Array]:
    """Correction (S,) and covariance (S, S) from weighted residuals (K, 2) linearised at the correction ``at`` (3,)."""
    jacobian = blocks.reshape(-1, 3)
    weighted = jacobian.T * np.repeat(weight, 2)
    information = prior.copy()
    information[:3, :3] += weighted @ jacobian
    updated = np.asarray(np.linalg.inv(information), dtype=float)
    return updated[:, :3] @ (weighted @ (jacobian @ at - residual.ravel())), updated


def _per_landmark(residual: Array, blocks: Array, covariance: Array) -> Array:
    """Normalised innovation squared (K,) of each landmark by itself."""
    s = blocks @ covariance @ blocks.transpose(0, 2, 1)
    a, b, c = s[:, 0, 0] + 1.0, s[:, 0, 1], s[:, 1, 1] + 1.0
    x, y = residual[:, 0], residual[:, 1]
    return np.asarray((c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b))
