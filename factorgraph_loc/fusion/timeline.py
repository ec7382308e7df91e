"""The order of time in all estimators: measurements before the start, late ones, and replay.

A measurement that is late by more than ``max_delay`` is counted and dropped. For another late one a filter goes back to its state
before then and processes the later measurements again; a graph adds a factor at its time. Before a start that is not known the
measurements are kept until the search has found one pose, and then processed from the first on.
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
    """A processed measurement, the estimator's state before it (``checkpoint``), and its additions to the diagnostics."""

    measurement: Measurement
    checkpoint: Any = None
    added: Sequence[Addition] = ()


class Timeline(ABC):
    """The order of time in an estimator; see the module."""

    deterministic = True
    takes_rows = True  # of odometry, as one measurement
    modalities: Container[str] = EVERY  # of measurements that may update it; others are counted as ignored

    def __init__(self, motion: Motion, diagnostics: Diagnostics, max_delay: float) -> None:
        self.diagnostics, self._motion, self._max_delay = diagnostics, motion, max_delay
        self._sensors: dict[str, Sensor] = {}  # by name
        self._t = -math.inf  # the newest time
        self._begun = math.inf  # when the estimator started; infinite before
        self._taken: deque[Taken] = deque()  # the last measurements, in their order of processing
        self._seeking: Tracking | None = None  # finds the start with the measurements that are kept

    def process(self, measurement: Measurement) -> None:
        """Take one measurement, in time or late by at most ``max_delay``."""
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
        """The pose at the time of the newest measurement or tick, or at ``t`` if that is later.

        Before the start: the most likely hypothesis of the search, ``ambiguous``, or NaN if there is none. Later it is
        ``ambiguous`` while a search is going on, and while the track does not explain the measurements.
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
        """The belief behind :meth:`estimate`; before the start all hypotheses of the search, and its particles."""
        if self._begun < math.inf or self._seeking is None:
            return gaussian_belief(self.estimate(t))
        at = self._t if t is None else max(t, self._t)
        particles = self._seeking.particles(at)
        return Belief(tuple(self._seeking.modes(at)), *(() if particles is None else particles))

    @abstractmethod
    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian."""

    @abstractmethod
    def _estimate_at(self, t: float | None) -> PoseEstimate:
        """:meth:`estimate` after the start."""

    @abstractmethod
    def _process(self, m: Measurement) -> None:
        """Process a measurement that is not too late."""

    def _renew(self, m: Measurement) -> None:
        """A measurement arrives: discard what was computed for questions before it."""
        return

    def _uses(self, m: Measurement) -> bool:
        """Whether a measurement may update the estimator."""
        return m.source in self._sensors

    def _begin(self, m: Measurement) -> None:
        """Process a measurement before the start."""
        if self._seeking is not None:
            self._seek_start(m, self._seeking)

    def _seek_heading(self, prior: PosePrior, search: Tracking) -> None:
        """Search the heading at a known position."""
        self._t, self._seeking = prior.t, search
        search.begin(KnownPosition(prior, self._motion))

    def _seek_start(self, m: Measurement, search: Tracking) -> None:
        """Search with a measurement; if that gives one pose, start there and process all measurements again."""
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
        """The prior at ``t``. ``best``: the pose of the search; ``moved``: the motion from ``t`` to that pose; ``start``: the known
        position at ``t``, if any."""
        raise NotImplementedError

    def _replay(self, measurements: Sequence[Measurement]) -> None:
        """Process measurements again."""
        for m in measurements:
            self._process(m)

    def _remember(self, taken: Taken, span: float) -> None:
        """Keep a measurement for ``span`` [s]."""
        self._taken.append(taken)
        while self._taken[0].measurement.t < taken.measurement.t - span:
            self._taken.popleft()

    def _take_back(self, t: float) -> list[Measurement]:
        """Undo the measurements from ``t`` on; returned are these in the order of their times."""
        undone = [taken for taken in self._taken if taken.measurement.t >= t]
        self._taken = deque(taken for taken in self._taken if taken.measurement.t < t)
        for taken in reversed(undone):
            self.diagnostics.take_back(taken.added)
            self._go_back(taken)
        return sorted((taken.measurement for taken in undone), key=lambda m: m.t)

    def _go_back(self, taken: Taken) -> None:
        """Return to the state before a measurement."""
        return

    def _drop_late(self, m: Measurement) -> None:
        if not isinstance(m, Tick):
            self.diagnostics.drop_late(m.source, m.count)
