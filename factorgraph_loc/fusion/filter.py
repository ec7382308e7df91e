"""The common base of filters: prediction by odometry, checkpoints for late measurements, and a record of all estimates."""

from __future__ import annotations

import bisect
import math
from abc import abstractmethod
from collections import deque
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from pydantic import Field

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.fusion.timeline import Taken, Timeline
from factorgraph_loc.fusion.tracking import Tracked
from factorgraph_loc.model.belief import Learnt, PoseEstimate, PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement, Tick
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.base import EarlierPose
from factorgraph_loc.sensors.motion import MOTION, Motion
from factors import se2
from factors.motion import ChainState
from factors.se2 import Array


class FilterSettings(FileModel):
    """Settings that all filters have."""

    max_delay: Annotated[float, Field(ge=0.0, le=5.0), InUnit("s")] = 0.5
    """largest delay of a measurement; later measurements are counted and ignored"""
    smooth: bool = True
    """whether the final trajectory uses all measurements; otherwise it equals the causal estimates"""


class Checkpoint(NamedTuple):
    """A copy of a filter's state, to restore if a measurement arrives after newer ones. ``state``: the estimate. ``t``
    [s]: its time. ``odometry``: the integrated odometry at ``t``. ``records``: the number of records stored for
    smoothing so far. ``ticks``: the number of times so far at which the run recorded the pose."""

    state: Any
    t: float
    odometry: ChainState
    records: int
    ticks: int


class FilterView:
    """Gives sensors read access to a filter's present state (see :class:`~factorgraph_loc.sensors.base.View`)."""

    offset = None
    newest = True

    def __init__(self, owner: Any) -> None:
        self._filter, self.t = owner, owner._t

    @property
    @abstractmethod
    def pose(self) -> Array: ...
    @property
    @abstractmethod
    def covariance(self) -> Array: ...
    @abstractmethod
    def value(self, name: str) -> Array | None: ...

    def poses_at(self, times: Array) -> Array:
        """Return the robot's poses (N, 3) at earlier ``times`` (N,) [s] by odometry, in the frame of its current
        pose."""
        constants = self.value(MOTION)
        values = np.zeros(0) if constants is None else constants
        return np.asarray(self._filter._motion.poses_at(self._filter._odometry, times, values))

    def earlier(self, t: float) -> EarlierPose | None:
        """Return None, because filters have no estimates of earlier poses."""
        return None

    def track(self) -> Tracked:
        """Return the current estimate of the pose, its covariance, and the integrated odometry at the same time."""
        return Tracked(self._filter._odometry, self.pose, self.covariance)

    def pose_back(self, t: float, pose: Array) -> Array:
        """Return the robot's pose (3,) in the world frame at an earlier time ``t`` [s]. It is computed by odometry from
        its current ``pose`` (3,)."""
        return se2.compose(pose, self.poses_at(np.array([t]))[0])


class Filter(Timeline):
    """A recursive estimator. It predicts its state by odometry to the time of each measurement, then updates the state.

    A state is replaced and never changed in place, so that a checkpoint needs no copy.
    """

    supports_unknown_start = False

    def __init__(self, setup: Setup, settings: FilterSettings, diagnostics: Diagnostics | None = None) -> None:
        diagnostics = Diagnostics() if diagnostics is None else diagnostics
        calibrates = getattr(settings, "self_calibration", False)
        motion = Motion(setup.rig, setup.sensors, diagnostics, self_calibration=calibrates)
        super().__init__(motion, diagnostics, settings.max_delay)
        self._smooth = settings.smooth
        self._state: Any = None
        # the last requested prediction and the state it started from, so that the next request can continue from it
        self._ahead: tuple[Any, Filter] | None = None
        self._odometry = ChainState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        # False until the first measurement after a start: until then, odometry from before the start may still arrive
        self._moves = False
        self._ticks: list[float] = []
        self._records: list[Any] = []

    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian prior of the pose."""
        self._t = self._begun = prior.t
        self._odometry, self._moves, self._seeking = self._motion.state(prior.t), False, None
        self._state = self._start(prior)
        self._taken.clear()

    def _wait(self, t: float) -> None:
        """Reset the filter, so that it waits for a start at or after time ``t`` [s]. Until then :meth:`_begin`
        processes the measurements."""
        self._t, self._begun, self._state = t, math.inf, None
        self._taken.clear()

    def _renew(self, m: Measurement) -> None:
        if not isinstance(m, Tick):
            self._ahead = None

    def learnt(self) -> Learnt:
        """Return an empty result. Subclasses that estimate constants or landmarks override this method."""
        return Learnt()

    def forget(self, until: float) -> None:
        """Delete the trajectory before the time ``until`` [s]. The part that a measurement with a delay up to
        ``max_delay`` can still change is not deleted."""
        self._ahead = None
        t = min(until, self._t - self._max_delay)
        records = max(0, bisect.bisect_left(self._records, t, key=lambda record: record.t) - 1)
        ticks = bisect.bisect_left(self._ticks, self._records[records].t) if records else 0
        del self._records[:records], self._ticks[:ticks]

        def moved(at: Checkpoint | None) -> Checkpoint | None:
            return at and at._replace(records=at.records - records, ticks=at.ticks - ticks)

        self._taken = deque(taken._replace(checkpoint=moved(taken.checkpoint)) for taken in self._taken)

    @abstractmethod
    def trajectory(self) -> Trajectory:
        """Return the best estimates of all past poses, at the times at which the run recorded the pose."""

    @abstractmethod
    def _start(self, prior: PosePrior) -> Any:
        """Return the filter's first state for a Gaussian prior of the pose."""

    @abstractmethod
    def _predict(self, t: float) -> None:
        """Predict the state to time ``t`` [s] along the odometry."""

    @abstractmethod
    def _see(self, m: Any) -> None:
        """Update the state by the measurement ``m``. The state must already be predicted to the measurement's time."""

    def _pass(self, tick: Tick) -> None:
        """Continue a global search for the pose, if one is running. Called at each ``tick`` (a time at which a run
        records the pose)."""
        return

    @abstractmethod
    def _estimate(self) -> PoseEstimate:
        """Return the pose, covariance and status of the current state."""

    @abstractmethod
    def _record(self) -> Any:
        """Return the data of the current state that :meth:`trajectory` needs, with an attribute ``t``, the time [s]."""

    def _seek(self, m: Any) -> Any:
        """Return the filter's first state if the measurement ``m`` determines the start pose, otherwise None."""
        return None

    def _estimate_at(self, t: float | None) -> PoseEstimate:
        return self._at(t)._estimate()

    def _at(self, t: float | None) -> Self:
        """Return this filter, or a copy predicted to ``t`` [s] if ``t`` is later than its time. Do not change the
        copy."""
        if t is None or t <= self._t or self._state is None:
            return self
        self._ahead = None
        ahead = object.__new__(type(self))  # like copy.copy, in a third of the time
        vars(ahead).update(vars(self))
        ahead._anchor()
        ahead._move(t)
        self._ahead = self._state, ahead
        return ahead

    def _anchor(self) -> None:
        """Store the integrated odometry at the time of the filter's start. Call this at the first measurement after the
        start, when all odometry from before it has arrived."""
        if not self._moves:
            self._odometry, self._moves = self._motion.state(self._t), True

    def _move(self, t: float) -> None:
        """Predict to time ``t`` [s], or do nothing if the filter is already there."""
        if t <= self._t:
            return
        known, self._ahead = self._ahead, None
        if known is not None and known[0] is self._state and known[1]._t == t:
            vars(self).update(vars(known[1]))
            return
        self._predict(t)
        self._t = t

    def _begin(self, m: Measurement) -> None:
        """Process a measurement before the filter has started. The filter starts at the first measurement that
        determines the pose, or when a global search has found the pose."""
        if self._seeking is not None:
            super()._begin(m)
        elif not isinstance(m, Tick):
            self._t, self._odometry, self._moves = m.t, self._motion.state(m.t), True
            self._state = self._seek(m)
            if self._state is not None:
                self._begun = m.t
                self._records.append(self._record())
            elif not self.supports_unknown_start:
                self.diagnostics.ignore("before the start")

    def _process(self, m: Measurement) -> None:
        again = self._take_back(math.nextafter(m.t, math.inf)) if m.t < self._t else []
        for measurement in (m, *again):
            self._take(measurement)

    def _take(self, m: Measurement) -> None:
        self._anchor()
        checkpoint = Checkpoint(self._state, self._t, self._odometry, len(self._records), len(self._ticks))
        added = self.diagnostics.record()
        self._move(m.t)
        if isinstance(m, Tick):
            self._ticks.append(m.t)
            self._pass(m)
        else:
            self._see(m)
        self.diagnostics.added = None
        self._records.append(self._record())
        self._remember(Taken(m, checkpoint, added), self._max_delay)

    def _go_back(self, taken: Taken) -> None:
        if taken.checkpoint is None:
            return
        self._state, self._t, self._odometry, records, ticks = taken.checkpoint
        del self._records[records:], self._ticks[ticks:]
        for sensor in self._sensors.values():
            sensor.rewind(self._t)


def at_ticks(ticks: Sequence[float], t: Array, poses: Array, body_covariances: Array) -> Trajectory:
    """Return a trajectory at the times ``ticks`` [s], made from records at the times ``t`` (N,) [s], ascending. The
    pose at a tick is that of the last record at or before the tick.

    ``poses`` (N, 3), ``body_covariances`` (N, 3, 3): the recorded estimates, with covariances in the body frame.
    """
    rows = np.searchsorted(t, np.unique(np.array(ticks)), side="right") - 1
    covariances = se2.body_to_world(poses[rows], body_covariances[rows])
    return Trajectory(np.unique(np.array(ticks)), poses[rows], covariances)


def twin(rng: np.random.Generator) -> np.random.Generator:
    """Return a copy of the random generator ``rng``, which will draw the same numbers as ``rng``."""
    bits = type(rng.bit_generator)(0)
    bits.state = rng.bit_generator.state
    return np.random.Generator(bits)
