"""Identified landmarks, as all estimators take them in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from factorgraph_loc.estimators.base import Diagnostics
from factorgraph_loc.estimators.registry import Setup
from factorgraph_loc.measurements import BearingRange
from factors import se2
from factors.bearing_range import BearingRangeModel, robust_weight, sigmas
from factors.bearing_range_factor import BearingRangeFactor
from factors.odometry import Increment
from factors.se2 import Array

CONVERGED = 1e-6  # of an iterated update, m and rad
EXACT = 0.1  # a survey that is so much better than the sensor (as a share of its sigma) is taken as exact
GATE = 9.21  # 99 % of chi-square with two degrees of freedom


MapUse = Literal["known", "extended", "unknown"]


class KnownLandmarks:
    """Turns measurements into factors; what the map or the rig lacks is counted as ignored.

    ``use`` of the map: ``known`` takes its landmarks as they are and ignores others, ``extended`` estimates the others, ``unknown``
    estimates all, as if there were no map. ``estimated``: places of the sensor's constants that are estimated.
    """

    def __init__(
        self, setup: Setup, diagnostics: Diagnostics, use: MapUse = "known", estimated: tuple[int, ...] = ()
    ) -> None:
        settings = setup.rig.bearing_range if "bearing_range" in setup.sensors else None
        self._model = None if settings is None else settings.model()
        landmarks = {} if use == "unknown" else setup.world.landmarks
        self._positions = {name: np.array((m.x, m.y)) for name, m in landmarks.items()}
        self._surveys = {name: m.spread() for name, m in landmarks.items()}
        worst = max((float(np.trace(spread)) for spread in self._surveys.values()), default=0.0)
        self._survey_matters = settings is not None and worst > (EXACT * settings.range_sigma) ** 2
        self._maps_others = use != "known"
        self._estimated = estimated
        self._diagnostics = diagnostics

    @property
    def known(self) -> bool:
        """Whether there is a sensor of landmarks, and a landmark in the map."""
        return self._model is not None and bool(self._positions)

    def factor(
        self, m: BearingRange, offset: Increment | None = None, twist: Array | None = None
    ) -> BearingRangeFactor | None:
        """The factor of the known landmarks, on the pose at its time, or on the one that lies ``offset`` before it.

        ``twist`` (3,): the robot's velocity then, where the sensor's time offset is estimated.
        """
        if self._model is None:
            self._diagnostics.ignore("bearing_range", len(m.landmarks))
            return None
        known = [i for i, name in enumerate(m.landmarks) if name in self._positions]
        rows = [i for i in known if not (np.isnan(m.range[i]) and np.isnan(m.bearing[i]))]
        if len(known) < len(m.landmarks) and not self._maps_others:
            self._diagnostics.ignore("landmark not in the map", len(m.landmarks) - len(known))
        if len(rows) < len(known):
            self._diagnostics.ignore("neither range nor bearing", len(known) - len(rows))
        if not rows:
            return None
        points = np.array([self._positions[m.landmarks[i]] for i in rows])
        factor = self._factor(self._model, m, rows, points, offset, twist)
        if self._survey_matters:
            spreads = np.array([self._surveys[m.landmarks[i]] for i in rows])
            factor = replace(factor, point_covariances=spreads)
        return factor

    def others(
        self, m: BearingRange, offset: Increment | None = None, twist: Array | None = None
    ) -> list[tuple[str, BearingRangeFactor]]:
        """The landmarks to be estimated by name, each with a factor on the pose and its position (the last value)."""
        if self._model is None or not self._maps_others:
            return []
        found = []
        for i, name in enumerate(m.landmarks):
            if name in self._positions:
                continue
            if np.isnan(m.range[i]) or np.isnan(m.bearing[i]):
                self._diagnostics.ignore("unknown landmark without range and bearing")
            else:
                factor = self._factor(self._model, m, [i], np.zeros((1, 2)), offset, twist)
                found.append((name, replace(factor, free=True)))
        return found

    def _factor(
        self,
        model: BearingRangeModel,
        m: BearingRange,
        rows: list[int],
        points: Array,
        offset: Increment | None,
        twist: Array | None,
    ) -> BearingRangeFactor:
        return BearingRangeFactor(
            model,
            points,
            m.range[rows],
            m.bearing[rows],
            None if offset is None else offset.delta,
            None if offset is None else offset.covariance,
            estimated=self._estimated,
            twist=twist,
        )

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


def together(factors: Sequence[BearingRangeFactor]) -> BearingRangeFactor:
    """Factors on one pose alone, of one measurement, as one."""
    first, *others = factors
    if not others:
        return first
    covariances = [
        np.zeros((len(f.points), 2, 2)) if f.point_covariances is None else f.point_covariances for f in factors
    ]
    return replace(
        first,
        points=np.concatenate([f.points for f in factors]),
        ranges=np.concatenate([f.ranges for f in factors]),
        bearings=np.concatenate([f.bearings for f in factors]),
        point_covariances=np.concatenate(covariances),
    )


def robust_update(factor: BearingRangeFactor, pose: Array, covariance: Array, iterations: int) -> Update:
    """Kalman update of ``pose`` (3,) and further states by a factor on the pose alone; see :func:`update_state`.

    ``covariance`` (S, S): of the error state, whose first three components are the pose's body-frame perturbation.
    """

    def linearize(delta: Array) -> tuple[Array, Array]:
        residual, (block,) = factor.whitened([se2.compose(pose, se2.exp(delta[:3]))])
        return residual, block

    return update_state(linearize, covariance, factor.model.robust, iterations, factor.dof())


def update_state(
    linearize: Callable[[Array], tuple[Array, Array]], covariance: Array, robust: float, iterations: int, dof: int
) -> Update:
    """Kalman update, robust and iterated, in information form.

    ``covariance`` (S, S): of the error state. ``linearize(delta)``: whitened residual (K, 2) and Jacobian (K, 2, D) by the first D
    components of the error state, with the state moved by ``delta`` (S,). ``robust``: scale of the loss. At first a
    landmark whose normalised innovation squared lies beyond the gate has its noise widened by the square of the excess, so that
    it pulls the less the farther off it is, but never locks the filter out. Further iterations widen it by the inverse of its
    robust weight at the updated state (iteratively reweighted least squares).
    """
    prior = np.asarray(np.linalg.inv(covariance), dtype=float)
    zero = np.zeros(len(covariance))
    residual, blocks = linearize(zero)
    size = blocks.shape[2]
    widening = np.maximum(1.0, _per_landmark(residual, blocks, covariance[:size, :size]) / GATE)
    delta, updated = _solve(prior, blocks, residual, np.ones(len(residual)), zero[:size])
    # by the matrix inversion lemma
    pull = np.einsum("kij,ki->j", blocks, residual)
    nis = float(np.vdot(residual, residual) - pull @ updated[:size, :size] @ pull)
    if widening.max() > 1.0:
        delta, updated = _solve(prior, blocks, residual, widening**-2, zero[:size])
    first = residual
    for _ in range(iterations - 1):
        residual, blocks = linearize(delta)
        weight = robust_weight(np.einsum("ki,ki->k", residual, residual), robust)
        before = delta
        delta, updated = _solve(prior, blocks, residual, weight, delta[:size])
        if np.abs(delta - before).max() < CONVERGED:
            break
    return Update(delta, (updated + updated.T) / 2.0, first, nis, dof)


def _solve(prior: Array, blocks: Array, residual: Array, weight: Array, at: Array) -> tuple[Array, Array]:
    """Correction (S,) and covariance (S, S) from weighted residuals (K, 2) linearised at the correction ``at`` (D,)."""
    size = len(at)
    jacobian = blocks.reshape(-1, size)
    weighted = jacobian.T * np.repeat(weight, 2)
    information = prior.copy()
    information[:size, :size] += weighted @ jacobian
    updated = np.asarray(np.linalg.inv(information), dtype=float)
    return updated[:, :size] @ (weighted @ (jacobian @ at - residual.ravel())), updated


def _per_landmark(residual: Array, blocks: Array, covariance: Array) -> Array:
    """Normalised innovation squared (K,) of each landmark by itself."""
    s = blocks @ covariance @ blocks.transpose(0, 2, 1)
    a, b, c = s[:, 0, 0] + 1.0, s[:, 0, 1], s[:, 1, 1] + 1.0
    x, y = residual[:, 0], residual[:, 1]
    return np.asarray((c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b))
