"""The main loop of a run: it passes measurements to the estimator in the order of arrival, and records estimates at regular ticks.

These estimates are called causal, because they use only measurements that have arrived before the tick.
"""

import bisect
import gc
import math
import resource
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby, islice, takewhile
from operator import attrgetter
from pathlib import Path
from time import perf_counter

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.fusion.base import Estimator, RecordingEstimator, record_each
from factorgraph_loc.fusion.guarded import Guard, sound
from factorgraph_loc.model.belief import PoseEstimate, PosePrior, Status
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Measurement, Rows
from factorgraph_loc.model.result import Timings
from factorgraph_loc.model.scoring import Ticks
from factorgraph_loc.model.setup import MapFrame
from factorgraph_loc.sensors.camera.use import PreparedLog
from factorgraph_loc.text import listed
from factors.se2 import Array

SPAN = 1.0  # s; rows of odometry in this time are processed together, before the ticks between them
JOINED = 100  # largest number of ticks that an estimator processes together
GARBAGE_THRESHOLDS = 20_000, 20, 20  # see the documentation of ``gc.set_threshold``


@dataclass
class CausalEstimates:
    """The estimates of a run, recorded online at regular times (ticks). Each field is a list with one entry per tick.

    ``t``: times [s]. ``poses``: arrays (3,) of x, y [m] and heading [rad]. ``covariances``: arrays (3, 3). ``status``:
    whether the pose is known, ambiguous or unknown. ``doubts_model``: True if measurements contradict the model of
    their sensor.
    """

    t: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    status: list[Status] = field(default_factory=list)
    doubts_model: list[bool] = field(default_factory=list)

    def add(self, t: float, e: PoseEstimate) -> None:
        """Append the estimate ``e`` at the tick ``t`` [s]. Arrays are copied, because an estimator may reuse them."""
        self.t.append(t)
        self.poses.append(e.pose.copy())
        self.covariances.append(e.covariance.copy())
        self.status.append(e.status)
        self.doubts_model.append(e.doubts_model)


@dataclass
class CausalRun:
    """The main loop of one run of an estimator on a log. Estimates are recorded at regular times (``ticks``).

    ``guard``: converts exceptions of the estimator to RunFailedError. ``sensors``: names of the used sensors.
    ``prior``: prior of the start pose, None if it is unknown. ``frame``: adds the error of the map to priors and
    estimates. ``progress``: called with the completed fraction. ``watch``: called with the time [s] and the estimator
    after each tick. ``end`` [s]: later measurements are not processed. ``estimates``: the recorded estimates.
    """

    guard: Guard
    estimator: Estimator
    log: Log
    sensors: tuple[str, ...]
    prior: PosePrior | None
    ticks: Ticks
    frame: MapFrame
    progress: Callable[[float], None] = lambda _: None
    watch: Callable[[float, Estimator], None] | None = None
    end: float = math.inf
    estimates: CausalEstimates = field(default_factory=CausalEstimates)

    def __post_init__(self) -> None:
        first, self._last = span_of(self.log, self.sensors)
        self._start = first if self.prior is None else self.prior.t
        self._initialized = self.prior is None
        self._record: Callable[[Sequence[float]], list[PoseEstimate]] = partial(record_each, self.estimator)
        self._joined = 1
        if isinstance(self.estimator, RecordingEstimator) and self.watch is None:
            self._record, self._joined = self.estimator.record, JOINED
        self._reported = self._seconds = 0.0
        self._update_t: list[float] = []
        self._update_s: list[float] = []

    def run(self) -> None:
        """Process all measurements, record the estimates at all ticks, and measure the computing times."""
        started = perf_counter()
        for (t, is_motion), group in groupby(self._measurements(), attrgetter("t", "is_motion")):
            if is_motion:
                for m in group:
                    self._move(m)
                continue
            self._reach(t)
            if t < self._start:
                self.estimator.diagnostics.ignore("before the start", sum(1 for _ in group))
            else:
                if not self._initialized:
                    self._initialize()
                self._update(t, group)
        if not self._initialized:
            self._initialize()
        self._pass(self.ticks.rest())
        self._seconds = perf_counter() - started
        self.progress(1.0)

    def timings(self, final_seconds: float, prepared: PreparedLog) -> Timings:
        """Return the computing times of a run. Call this after :meth:`run`.

        ``final_seconds`` [s]: time for the final trajectory. ``prepared``: the log that was processed. It has the
        number of images, and the time for the detection of features in them.
        """
        return Timings(
            update_t=np.array(self._update_t),
            update_ms=np.array(self._update_s) * 1e3,
            causal_seconds=self._seconds,
            real_time_factor=self.ticks.seconds / self._seconds,
            final_seconds=final_seconds,
            peak_memory_mb=_peak_memory_mb(),
            images=prepared.images,
            frontend_seconds=prepared.seconds,
        )

    def _measurements(self) -> Iterator[Measurement]:
        """Return the measurements until ``end`` [s], in order of time. If the estimator has the attribute
        ``takes_rows``, successive measurements of odometry are arrays in one ``Rows`` object."""
        joined = getattr(self.estimator, "takes_rows", False)
        steps = self.log.steps(self.sensors) if joined else self.log.measurements(self.sensors)
        return takewhile(lambda m: m.t <= self.end, steps)

    def _reach(self, t: float) -> None:
        """Record the estimates at all ticks before the time ``t`` [s] of the next measurement. If ``t`` is later than
        the start and the estimator is not initialized yet, first initialize it."""
        if not self._initialized and t > self._start:
            self._initialize()
        self._pass(self.ticks.advance(t))

    def _move(self, m: Measurement) -> None:
        """Process ``m``, one measurement of odometry or several in a ``Rows`` object. The estimates at ticks between
        the measurements of ``Rows`` are recorded after all of them. This does not change them, because the state at a
        tick depends only on earlier measurements."""
        if not isinstance(m, Rows):
            self._reach(m.t)
            self.guard.process(self.estimator, m)
            return
        times, first = m.times.tolist(), 0
        while first < len(times):
            self._reach(times[first])
            end = times[first] + min(SPAN, self.ticks.gap)
            last = bisect.bisect_right(times, end if self._initialized else min(end, self._start), first + 1)
            self.guard.process(self.estimator, m if last - first == len(times) else m.part(first, last))
            self._pass(self.ticks.advance(times[last - 1]))
            first = last

    def _initialize(self) -> None:
        """Initialize the estimator at the prior of the start pose."""
        assert self.prior is not None
        self._initialized = True
        with self.guard.computing("the start", self.prior.t):
            self.estimator.initialize(self.frame.prior(self.prior))

    def _update(self, t: float, measurements: Iterator[Measurement]) -> None:
        """Process the measurements that arrive at ``t`` [s], and measure the time until the estimate is available."""
        started = perf_counter()
        for m in measurements:
            self.guard.process(self.estimator, m)
        with self.guard.computing("the estimate", t):
            sound(self.estimator.estimate())
        self._update_s.append(perf_counter() - started)
        self._update_t.append(t)

    def _pass(self, ticks: Iterable[float]) -> None:
        """Record the estimates at ``ticks`` [s]. The estimator processes up to ``_joined`` of them by one call."""
        remaining = iter(ticks)
        while some := tuple(islice(remaining, self._joined)):
            self._tick(some)

    def _tick(self, ticks: Sequence[float]) -> None:
        """Record the estimates at ``ticks`` [s] by one call, and report the progress."""
        with self.guard.computing("the estimate", ticks[0]):
            recorded = self._record(ticks)
        for t, e in zip(ticks, recorded, strict=True):
            with self.guard.computing("the estimate", t):
                self.estimates.add(t, self.frame.estimate(sound(e)))
        t = ticks[-1]
        if self.watch is not None:
            self.watch(t, self.estimator)
        share = (t - self._start) / max(self._last - self._start, 1e-9)
        if share >= self._reported:
            self.progress(share)
            self._reported = share + 0.01


def span_of(log: Log, sensors: tuple[str, ...]) -> tuple[float, float]:
    """Return the first and the last timestamp [s] of the measurements of ``sensors``. Raises InputError without any."""
    streams = {s: log.streams[s].t for s in sensors if s in log.streams}
    stamps: list[Array] = [t + log.rig.time_offset(s) for s, t in streams.items() if len(t)]
    if not stamps:
        raise InputError(f"{log.name}: has no measurements of {listed(sensors)}")
    return min(float(t.min()) for t in stamps), max(float(t.max()) for t in stamps)


@contextmanager
def rare_garbage_collection() -> Iterator[None]:
    """Make Python collect garbage less often in this block, and only objects that are created in the block."""
    if gc.get_freeze_count():
        yield
        return
    thresholds = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(*GARBAGE_THRESHOLDS)
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()


def _peak_memory_mb() -> float:
    """Return the peak resident memory of this process in 10^6 bytes."""
    # getrusage includes memory of the parent process at the time of the fork, but /proc does not
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return float(status.split("VmHWM:")[1].split()[0]) * 1024 / 1e6
    except (OSError, IndexError):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6
