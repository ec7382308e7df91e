"""Odometry alone: what every other estimator has to beat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_loc.fusion.filter import Filter, FilterSettings, at_ticks, world_estimate
from factorgraph_loc.model.belief import PoseEstimate, PosePrior
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.trajectory import Trajectory
from factors import se2
from factors.motion import propagate
from factors.se2 import Array


class DeadReckoningSettings(FilterSettings):
    """Settings of dead reckoning, which has none of its own."""


@dataclass(frozen=True)
class _PoseState:
    pose: Array
    covariance: Array  # body frame


@dataclass(frozen=True)
class _PoseRecord:
    t: float
    state: _PoseState


class DeadReckoning(Filter):
    """Odometry only, with a covariance that grows with the distance."""

    modalities = frozenset[str]()
    smoothed = False
    _state: _PoseState

    def trajectory(self) -> Trajectory:
        """The same as the causal estimates: there is nothing to smooth."""
        records: list[_PoseRecord] = self._records
        return at_ticks(
            self._ticks,
            np.array([r.t for r in records]),
            np.array([r.state.pose for r in records]),
            np.array([r.state.covariance for r in records]),
        )

    def _start(self, prior: PosePrior) -> _PoseState:
        return _PoseState(np.array(prior.pose, dtype=float), se2.world_to_body(prior.pose, prior.covariance))

    def _predict(self, t: float) -> None:
        s, increment = self._state, self._travelled(t)
        self._state = _PoseState(se2.compose(s.pose, increment.delta), propagate(s.covariance, increment))

    def _see(self, m: Measurement) -> None:
        raise AssertionError("dead reckoning has no sensor but odometry")

    def _estimate(self) -> PoseEstimate:
        return world_estimate(self._t, self._state.pose, self._state.covariance)

    def _record(self) -> _PoseRecord:
        return _PoseRecord(self._t, self._state)
