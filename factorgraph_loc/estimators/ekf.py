"""Extended Kalman filter on SE(2), with Rauch-Tung-Striebel smoothing for its final trajectory.

The error state is a body-frame perturbation of the pose, followed by that of the odometry's constants that are estimated
(Sola, Deray, Atchuthan, 2018, section IV). A measurement whose innovation is too large has its noise widened instead
of being dropped, so that the filter cannot lock itself out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.estimators.base import Learnt, PoseEstimate, PosePrior
from factorgraph_loc.estimators.filtering import Filter, FilterSettings, at_ticks, world_estimate
from factorgraph_loc.estimators.landmarks import KnownLandmarks, robust_update
from factorgraph_loc.estimators.registry import Setup
from factorgraph_loc.measurements import BearingRange
from factorgraph_loc.trajectory import Trajectory
from factors import se2
from factors.odometry import PARAMETERS, Increment, recalibrated
from factors.se2 import Array


class EkfSettings(FilterSettings):
    """``iterations``: 1 is the plain update; more linearise again at the updated pose (Bell and Cathey, 1993)."""

    iterations: Annotated[int, Field(ge=1, le=20)] = 1


@dataclass(frozen=True)
class _State:
    """``pose`` (3,), ``parameters`` (P,) of the odometry, ``covariance`` (3+P, 3+P) of their error state."""

    pose: Array
    parameters: Array
    covariance: Array

    def plus(self, delta: Array, covariance: Array) -> _State:
        return _State(se2.compose(self.pose, se2.exp(delta[:3])), self.parameters + delta[3:], covariance)

    def minus(self, other: _State) -> Array:
        return np.concatenate((se2.log(se2.between(other.pose, self.pose)), self.parameters - other.parameters))


@dataclass(frozen=True)
class _Record:
    t: float
    predicted: _State
    transition: Array  # from the record before to ``predicted``
    updated: _State


class Ekf(Filter):
    """The EKF; see the module."""

    _state: _State

    def __init__(self, setup: Setup, settings: EkfSettings) -> None:
        super().__init__(setup, settings)
        self._iterations = settings.iterations
        self._landmarks = KnownLandmarks(setup, self.diagnostics)
        self._estimated = setup.rig.estimated_odometry()
        self._predicted: _State | None = None
        self._transition = np.eye(3)

    def learnt(self) -> Learnt:
        """The odometry's constants that are estimated."""
        if self._state is None:
            return Learnt()
        sigmas = np.sqrt(np.diag(self._state.covariance)[3:])
        return Learnt(
            {
                n: (float(v), float(s))
                for n, v, s in zip(self._estimated.names, self._state.parameters, sigmas, strict=True)
            }
        )

    def trajectory(self) -> Trajectory:
        """The smoothed estimates (Rauch, Tung, Striebel, 1965), or the causal ones with ``smooth`` off."""
        records: list[_Record] = self._records
        states = [r.updated for r in records]
        if self._smooth:
            for k in range(len(records) - 2, -1, -1):
                after, smoothed, here = records[k + 1], states[k + 1], states[k]
                gain = np.linalg.solve(after.predicted.covariance, after.transition @ here.covariance).T
                change = smoothed.covariance - after.predicted.covariance
                states[k] = here.plus(gain @ smoothed.minus(after.predicted), here.covariance + gain @ change @ gain.T)
        return at_ticks(
            self._ticks,
            np.array([r.t for r in records]),
            np.array([s.pose for s in states]),
            np.array([s.covariance[:3, :3] for s in states]),
        )

    def _start(self, prior: PosePrior) -> _State:
        count = len(self._estimated.indices)
        covariance = np.zeros((3 + count, 3 + count))
        covariance[:3, :3] = se2.world_to_body(prior.pose, prior.covariance)
        covariance[3:, 3:] = np.diag(self._estimated.sigmas**2)
        return _State(np.array(prior.pose, dtype=float), np.zeros(count), covariance)

    def _predict(self, increment: Increment) -> None:
        s = self._state
        delta, by_parameter = increment.delta, np.zeros((3, 0))
        if len(s.parameters):
            delta, jacobian = recalibrated(increment, self._estimated.full(s.parameters, len(PARAMETERS)))
            by_parameter = jacobian[:, list(self._estimated.indices)]
        transition = np.eye(len(s.covariance))
        transition[:3, :3] = se2.adjoint(se2.inverse(delta))
        transition[:3, 3:] = by_parameter
        covariance = transition @ s.covariance @ transition.T
        covariance[:3, :3] += increment.covariance
        self._state = replace(s, pose=se2.compose(s.pose, delta), covariance=covariance)
        self._predicted, self._transition = self._state, transition

    def _update(self, m: BearingRange) -> None:
        seen = self._landmarks.factor(m)
        if seen is None:
            return
        prior = self._state
        if self._predicted is None:
            self._predicted = prior
        update = robust_update(seen, prior.pose, prior.covariance, self._iterations)
        self._landmarks.report(m.t, seen, update)
        self._state = prior.plus(update.delta, update.covariance)

    def _estimate(self) -> PoseEstimate:
        return world_estimate(self._t, self._state.pose, self._state.covariance[:3, :3])

    def _record(self) -> _Record:
        predicted = self._predicted or self._state
        record = _Record(self._t, predicted, self._transition, self._state)
        self._predicted, self._transition = None, np.eye(len(self._state.covariance))
        return record
