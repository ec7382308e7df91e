"""What the filters have in common: time, odometry, late measurements, the record of the run."""

from __future__ import annotations

import bisect
import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Container, Sequence
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from pydantic import Field

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.fusion.base import EVERY
from factorgraph_loc.model.belief import Belief, Learnt, PoseEstimate, PosePrior, Status, gaussian_belief
from factorgraph_loc.model.diagnostics import Addition, Diagnostics
from factorgraph_loc.model.measurement import Measurement, Tick
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.base import Sensor
from factorgraph_loc.sensors.motion import Motion
from factors import se2, se2_kernels
from factors.motion import ChainState, Increment
from factors.se2 import Array


class FilterSettings(FileModel):
    """Settings of every filter."""

    max_delay: Annotated[float, Field(ge=0.0, le=5.0), InUnit("s")] = 0.5
    """how late a measurement may come; later ones are counted and dropped"""
    smooth: bool = True
    """whether the final trajectory uses all measurements, else it repeats the causal one"""


class Taken(NamedTuple):
    """A measurement with what there was before it: the filter's state, time and odometry, and how many records and ticks; and what
    the diagnostics say of it."""

    measurement: Measurement
    state: Any
    t: float
    odometry: ChainState
    records: int
    ticks: int
    written: list[Addition]


class Filter(ABC):
    """A recursive estimator: predicts along the odometry to each measurement's time, then updates.

    The state is replaced, never changed in place, so that a checkpoint costs nothing: a late measurement goes back to the
    checkpoint before its time and takes those since then once more.
    """

    deterministic = True
    supports_unknown_start = False
    takes_rows = True  # of odometry, as one measurement
    modalities: Container[str] = EVERY  # of measurements that may update it; others are counted as ignored

    def __init__(self, setup: Setup, settings: FilterSettings, diagnostics: Diagnostics | None = None) -> None:
        self.diagnostics = Diagnostics() if diagnostics is None else diagnostics
        self._max_delay = settings.max_delay
        self._smooth = settings.smooth
        calibrates = getattr(settings, "self_calibration", False)
        self._motion = Motion(setup.rig, setup.sensors, self.diagnostics, self_calibration=calibrates)
        self._sensors: dict[str, Sensor] = {}  # by the modality of their measurements
        self._rng: np.random.Generator | None = None  # of a filter whose predictions draw
        self._state: Any = None
        # the last one that was ahead of this one, and the state that it began with: the next tick need not go there once more
        self._ahead: tuple[Any, Filter] | None = None
        self._t = -math.inf
        self._odometry = ChainState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        # whether the odometry at the state's time counts: at a start rows of before it may still come
        self._moves = False
        self._ticks: list[float] = []
        self._records: list[Any] = []
        self._taken: deque[Taken] = deque()  # the last ones, as far back as one may be late

    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian."""
        self._t, self._odometry, self._moves = prior.t, self._motion.state(prior.t), False
        self._state = self._start(prior)
        self._taken.clear()

    def _wait(self, t: float) -> None:
        """Begin at ``t`` without a state: measurements go to :meth:`_begin`."""
        self._t, self._state = t, None
        self._taken.clear()

    def process(self, measurement: Measurement) -> None:
        """Take one measurement, in time or late by at most ``max_delay``."""
        if measurement.is_motion:
            self._ahead = None
            self._motion.add(measurement)
            return
        if not isinstance(measurement, Tick):
            self._ahead = None
            if not self._uses(measurement.modality):
                self.diagnostics.ignore(measurement.modality, measurement.count)
                return
        if self._state is None:
            self._begin(measurement)
        elif measurement.t >= self._t:
            self._take(measurement)
        elif measurement.t < self._t - self._max_delay or not self._taken:
            self._drop_late(measurement)
        else:
            self._take_late(measurement)

    def _uses(self, modality: str) -> bool:
        """Whether measurements of a modality may update it."""
        return modality in self._sensors

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The pose at the time of the newest measurement or tick, or at ``t`` if that is later; not a number before the start."""
        if self._state is None:
            return PoseEstimate(self._t, np.full(3, np.nan), np.full((3, 3), np.nan), "unlocalized")
        return self._at(t)._estimate()

    def belief(self, t: float | None = None) -> Belief:
        """The belief behind :meth:`estimate`."""
        return gaussian_belief(self.estimate(t))

    def learnt(self) -> Learnt:
        """Nothing, unless the filter says otherwise."""
        return Learnt()

    def forget(self, before: float) -> None:
        """Forget the trajectory before then, but not what late measurements may still change."""
        self._ahead = None
        t = min(before, self._t - self._max_delay)
        records = max(0, bisect.bisect_left(self._records, t, key=lambda record: record.t) - 1)
        ticks = bisect.bisect_left(self._ticks, self._records[records].t) if records else 0
        del self._records[:records], self._ticks[:ticks]
        self._taken = deque(
            taken._replace(records=taken.records - records, ticks=taken.ticks - ticks) for taken in self._taken
        )

    @abstractmethod
    def trajectory(self) -> Trajectory:
        """The best estimate of the whole past at the stamps of the ticks."""

    @abstractmethod
    def _start(self, prior: PosePrior) -> Any:
        """The state that stands for the prior."""

    @abstractmethod
    def _predict(self, t: float) -> None:
        """Move the state along to ``t``, and the odometry."""

    @abstractmethod
    def _see(self, m: Any) -> None:
        """Take what a sensor saw at the state's time."""

    def _pass(self, tick: Tick) -> None:
        """At a tick, once the state is there: go on with what waits, if anything does."""
        return

    @abstractmethod
    def _estimate(self) -> PoseEstimate:
        """Mean and covariance of the state."""

    @abstractmethod
    def _record(self) -> Any:
        """What :meth:`trajectory` needs of this time, with its time as ``t``."""

    def _seek(self, m: Any) -> Any:
        """The state from a measurement alone, for an unknown start; None where it does not tell one."""
        return None

    def _at(self, t: float | None) -> Self:
        """The filter itself, or one that is ahead of it, by what :meth:`_take` would do at ``t``: it is there to be read."""
        if t is None or t <= self._t or self._state is None:
            return self
        self._ahead = None
        ahead = object.__new__(type(self))  # as copy.copy does, in a third of the time
        vars(ahead).update(vars(self))
        ahead._rng = None if self._rng is None else twin(self._rng)
        ahead._anchor()
        ahead._move(t)
        self._ahead = self._state, ahead
        return ahead

    def _anchor(self) -> None:
        """At the first measurement after a start: the odometry there is what has come by now."""
        if not self._moves:
            self._odometry, self._moves = self._motion.state(self._t), True

    def _move(self, t: float) -> None:
        """Go on to ``t``, or stay if that is now."""
        if t <= self._t:
            return
        known, self._ahead = self._ahead, None
        if known is not None and known[0] is self._state and known[1]._t == t:
            self._catch_up(known[1])
            return
        self._predict(t)
        self._t = t

    def _travelled(self, t: float) -> Increment:
        """The motion to ``t``, to which the odometry goes on."""
        self._odometry, increment = self._motion.travelled(self._odometry, t)
        return increment

    def _catch_up(self, ahead: Filter) -> None:
        """Take over what the one that is ahead has predicted; the generator stays, as others draw by it too."""
        rng = self._rng
        vars(self).update(vars(ahead))
        self._rng = rng
        if rng is not None and ahead._rng is not None:
            rng.bit_generator.state = ahead._rng.bit_generator.state

    def _begin(self, m: Measurement) -> None:
        """Start without a prior, at the first measurement that tells something of the pose."""
        if isinstance(m, Tick):
            return
        self._t, self._odometry, self._moves = m.t, self._motion.state(m.t), True
        self._state = self._seek(m)
        if self._state is not None:
            self._records.append(self._record())
        elif not self.supports_unknown_start:
            self.diagnostics.ignore("before the start")

    def _take(self, m: Measurement) -> None:
        self._anchor()
        before = (self._state, self._t, self._odometry, len(self._records), len(self._ticks))
        written = self.diagnostics.record()
        self._move(m.t)
        if isinstance(m, Tick):
            self._ticks.append(m.t)
            self._pass(m)
        else:
            self._see(m)
        self.diagnostics.added = None
        self._records.append(self._record())
        self._taken.append(Taken(m, *before, written))
        while self._taken[0].measurement.t < m.t - self._max_delay:
            self._taken.popleft()

    def _take_late(self, late: Measurement) -> None:
        again: list[Measurement] = []
        while self._taken and self._t > late.t:
            last = self._taken.pop()
            again.append(last.measurement)
            self._go_back(last)
        if self._t > late.t:
            self._drop_late(late)
        else:
            again.append(late)
        for m in sorted(again, key=lambda m: m.t):
            self._take(m)

    def _drop_late(self, m: Measurement) -> None:
        if not isinstance(m, Tick):
            self.diagnostics.drop_late(m.modality, m.count)

    def _go_back(self, taken: Taken) -> None:
        self._state, self._t, self._odometry = taken.state, taken.t, taken.odometry
        del self._records[taken.records :], self._ticks[taken.ticks :]
        self.diagnostics.take_back(taken.written)
        for sensor in self._sensors.values():
            sensor.rewind(self._t)


def at_ticks(ticks: Sequence[float], t: Array, poses: Array, body_covariances: Array) -> Trajectory:
    """The trajectory at the stamps ``ticks``, of records at times ``t`` (N,): the last record of each stamp counts."""
    rows = np.searchsorted(t, np.unique(np.array(ticks)), side="right") - 1
    covariances = se2.body_to_world(poses[rows], body_covariances[rows])
    return Trajectory(np.unique(np.array(ticks)), poses[rows], covariances)


def world_estimate(t: float, pose: Array, covariance: Array, status: Status = "localized") -> PoseEstimate:
    """An estimate from the covariance (S, S) of an error state that begins with the pose's body-frame perturbation."""
    return PoseEstimate(t, pose, se2_kernels.body_to_world(pose, covariance), status)


def twin(rng: np.random.Generator) -> np.random.Generator:
    """A generator that will draw the same numbers; a deep copy takes four times as long."""
    bits = type(rng.bit_generator)(0)
    bits.state = rng.bit_generator.state
    return np.random.Generator(bits)
