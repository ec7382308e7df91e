"""The order of measurements in time, for all estimators: measurements before the start, late measurements, and replay.

A measurement that is late by more than ``max_delay`` is counted and ignored. If a measurement is less late, a filter restores its
state from before that time and processes the later measurements again. A graph adds a factor at the measurement's time instead.
If the start pose is unknown, measurements are kept until a search has found the pose. Then they are processed from the first on.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Container, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from factorgraph_loc.fusion.base import EVERY
from factorgraph_loc.fusion.search import DURATION
from factorgraph_loc.fusion.tracking import Tracking
from factorgraph_loc.model.belief import Belief, PoseEstimate, PosePrior, gaussian_belief
from factorgraph_loc.model.diagnostics import Addition, Diagnostics
from factorgraph_loc.model.measurement import Measurement, Tick
from factorgraph_loc.sensors.base import Sensor
from factorgraph_loc.sensors.known_position import START_KEPT, KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factors.motion import Increment


class Taken(NamedTuple):
    """A processed measurement. ``checkpoint``: a copy of the estimator's state before the measurement, or None if it is
    not needed. ``added``: the entries that the measurement added to the diagnostics, to remove them if it is processed
    again."""

    measurement: Measurement
    checkpoint: Any = None
    added: Sequence[Addition] = ()


class Timeline(ABC):
    """The base class of estimators that process measurements in order of time. A measurement may also arrive after
    newer ones."""

    deterministic = True
    takes_rows = True  # one measurement may contain several rows of odometry
    # the kinds of sensors that the estimator uses; measurements of other sensors are only counted as ignored
    modalities: Container[str] = EVERY

    def __init__(self, motion: Motion, diagnostics: Diagnostics, max_delay: float) -> None:
        self.diagnostics, self._motion, self._max_delay = diagnostics, motion, max_delay
        self._sensors: dict[str, Sensor] = {}  # by name
        self._t = -math.inf  # s; the time of the newest measurement or recorded pose
        self._begun = math.inf  # s; the time of the estimator's start, infinite before the start
        self._taken: deque[Taken] = deque()  # the last measurements, in the order of processing
        self._seeking: Tracking | None = None  # the search for the start pose, None if there is none

    def process(self, measurement: Measurement) -> None:
        """Process one measurement. A measurement that is older than the newest one by more than ``max_delay`` is
        counted and ignored."""
        self._renew(measurement)
        if measurement.is_motion:
            self._motion.add(measurement)
        elif not (isinstance(measurement, Tick) or self._uses(measurement)):
            self.diagnostics.ignore(measurement.source, measurement.count)
        elif self._begun == math.inf:
            self._begin(measurement)
        elif measurement.t < max(self._t - self._max_delay, self._begun):
            self._drop_late(measurement)
        else:
            self._process(measurement)

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """Return the pose at the time of the newest measurement or recorded pose, or at ``t`` [s] if that is later.

        Before the estimator has started, this is the most likely result of the search for the start pose, with the
        status ``ambiguous``. If there is none, it is NaN, with the status ``unlocalized``. Later, the status is
        ``ambiguous`` while a search is in progress, and while the estimated poses contradict the measurements.
        """
        if self._begun < math.inf:
            estimate = self._estimate_at(t)
            doubts = any(sensor.doubts_model for sensor in self._sensors.values())
            return replace(estimate, doubts_model=True) if doubts else estimate
        at = self._t if t is None else max(t, self._t)
        modes = [] if self._seeking is None else self._seeking.modes(at)
        if not modes:
            return PoseEstimate(at, np.full(3, np.nan), np.full((3, 3), np.nan), "unlocalized")
        return PoseEstimate(at, modes[0].pose, modes[0].covariance, "ambiguous")

    def belief(self, t: float | None = None) -> Belief:
        """Return the probability distribution of the pose, at the same time as :meth:`estimate`. Before the estimator
        has started, it has all hypotheses and particles of the search for the start pose."""
        if self._begun < math.inf or self._seeking is None:
            return gaussian_belief(self.estimate(t))
        at = self._t if t is None else max(t, self._t)
        particles = self._seeking.particles(at)
        return Belief(tuple(self._seeking.modes(at)), *(() if particles is None else particles))

    @abstractmethod
    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian prior of the pose."""

    @abstractmethod
    def _estimate_at(self, t: float | None) -> PoseEstimate:
        """Return the result of :meth:`estimate`. Called only after the estimator has started."""

    @abstractmethod
    def _process(self, m: Measurement) -> None:
        """Process the measurement ``m``, which is at most ``max_delay`` older than the newest. Called only after the
        estimator has started."""

    def _renew(self, m: Measurement) -> None:
        """Discard cached results. Called when a measurement arrives."""
        return

    def _uses(self, m: Measurement) -> bool:
        """Return True if the estimator uses the sensor of the measurement."""
        return m.source in self._sensors

    def _begin(self, m: Measurement) -> None:
        """Process the measurement ``m`` while the estimator has no start pose yet."""
        if self._seeking is not None:
            self._seek_start(m, self._seeking)

    def _seek_heading(self, prior: PosePrior, search: Tracking) -> None:
        """Begin ``search`` for the heading. ``prior``: the known position, without a heading."""
        self._t, self._seeking = prior.t, search
        search.begin(KnownPosition(prior, self._motion))

    def _seek_start(self, m: Measurement, search: Tracking) -> None:
        """Update the search for the start pose by the measurement ``m``. If this determines the pose, the estimator
        starts there, and processes the stored measurements again."""
        start = search.start
        if start is not None:
            start.settle()
            if m.t < max(start.t, self._t - self._max_delay):
                self._drop_late(m)
                return
        self._t = max(self._t, m.t)
        is_informative = search.advance(m.t) if isinstance(m, Tick) else search.look(m, self._motion.state(m.t))
        if not is_informative and search.newest is None and not search.waits and start is None:
            return  # the run begins with the first informative measurement
        self._remember(Taken(m), DURATION if start is None else START_KEPT)
        best = search.best if is_informative else None
        if best is None:
            return
        again = self._take_back(-math.inf)
        self.diagnostics.event(m.t, "localized", "localized")
        kept = start if start is not None and self._t <= start.t + START_KEPT else None
        t = again[0].t if kept is None else kept.t
        moved = self._motion.relative(self._motion.state(t), self._motion.state(best.t))
        self.initialize(self._prior(t, best, moved, kept))
        search.begin_track(by_search=True)
        self._replay(again)

    def _prior(self, t: float, best: PosePrior, moved: Increment, start: KnownPosition | None) -> PosePrior:
        """Return the prior for a start at time ``t`` [s], computed from the result of a search.

        ``best``: the pose that the search found, at a later time. ``moved``: the robot's motion from ``t`` to that
        time. ``start``: the known position at ``t``, or None.
        """
        raise NotImplementedError

    def _replay(self, measurements: Sequence[Measurement]) -> None:
        """Process the ``measurements`` again, in their order."""
        for m in measurements:
            self._process(m)

    def _remember(self, taken: Taken, span: float) -> None:
        """Store the processed measurement ``taken``. Delete stored measurements that are more than ``span`` [s]
        older."""
        self._taken.append(taken)
        while self._taken[0].measurement.t < taken.measurement.t - span:
            self._taken.popleft()

    def _take_back(self, t: float) -> list[Measurement]:
        """Undo the processing of all measurements from time ``t`` [s] on. Returns these measurements in the order of
        their times."""
        undone = [taken for taken in self._taken if taken.measurement.t >= t]
        self._taken = deque(taken for taken in self._taken if taken.measurement.t < t)
        for taken in reversed(undone):
            self.diagnostics.take_back(taken.added)
            self._go_back(taken)
        return sorted((taken.measurement for taken in undone), key=lambda m: m.t)

    def _go_back(self, taken: Taken) -> None:
        """Restore the estimator's state from before the measurement ``taken``."""
        return

    def _drop_late(self, m: Measurement) -> None:
        if not isinstance(m, Tick):
            self.diagnostics.drop_late(m.source, m.count)
