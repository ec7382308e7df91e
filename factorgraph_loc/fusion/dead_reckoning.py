"""Dead reckoning: localization by odometry alone, the baseline for all estimators."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from factorgraph_loc.fusion.filter import Filter, FilterSettings, at_ticks
from factorgraph_loc.model.belief import PoseEstimate, PosePrior
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.trajectory import Trajectory
from factors import se2
from factors.motion import propagate
from factors.se2 import Array


class DeadReckoningSettings(FilterSettings):
    """Settings of dead reckoning: only the settings that all filters have."""


class _PoseRecord(NamedTuple):
    """The estimated pose (3,) and its body-frame covariance (3, 3) at time ``t`` [s]."""

    t: float
    pose: Array
    covariance: Array  # body frame


class DeadReckoning(Filter):
    """An estimator that uses only odometry. Its covariance grows with the distance travelled."""

    modalities = frozenset[str]()
    smoothed = False
    _state: tuple[Array, Array]  # pose (3,), and its body-frame covariance (3, 3)

    def trajectory(self) -> Trajectory:
        """Return the estimates during the run, at the times at which the run recorded the pose. They are not
        smoothed."""
        records: list[_PoseRecord] = self._records
        return at_ticks(
            self._ticks,
            np.array([r.t for r in records]),
            np.array([r.pose for r in records]),
            np.array([r.covariance for r in records]),
        )

    def _start(self, prior: PosePrior) -> tuple[Array, Array]:
        return np.array(prior.pose, dtype=float), se2.world_to_body(prior.pose, prior.covariance)

    def _predict(self, t: float) -> None:
        pose, covariance = self._state
        self._odometry, increment = self._motion.travelled(self._odometry, t)
        self._state = se2.compose(pose, increment.delta), propagate(covariance, increment)

    def _see(self, m: Measurement) -> None:
        raise AssertionError("dead reckoning processes no measurements except odometry")

    def _estimate(self) -> PoseEstimate:
        pose, covariance = self._state
        return PoseEstimate(self._t, pose, se2.body_to_world_one(pose, covariance), "localized")

    def _record(self) -> _PoseRecord:
        return _PoseRecord(self._t, *self._state)
