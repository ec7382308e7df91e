"""One run of an estimator on a log: process measurements in the order of arrival, and store and time the estimates."""

import bisect
import importlib.metadata
import math
import platform
import resource
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import groupby, takewhile
from operator import attrgetter
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from factorgraph_loc.errors import FglocError, InputError
from factorgraph_loc.experiments.causal_estimates import CausalEstimates
from factorgraph_loc.experiments.doubts import findable, in_bent_map, never_localized, partly_scored, with_pauses
from factorgraph_loc.experiments.garbage import only_new_searched
from factorgraph_loc.experiments.preparation import (
    KNOWN,
    at_origin,
    prepare,
    resolve_prior,
    unused,
    use_of,
    used_sensors,
    with_own_map,
)
from factorgraph_loc.files.models import FileModel
from factorgraph_loc.fusion import registry
from factorgraph_loc.fusion.base import ConcludingEstimator, Estimator, finds_heading
from factorgraph_loc.fusion.guarded import Guard, sound, sound_trajectory
from factorgraph_loc.fusion.map_frame import MapFrame
from factorgraph_loc.io.checks import require_bounds, require_one_span
from factorgraph_loc.model import setup as model_setup
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Measurement, Rows, Tick
from factorgraph_loc.model.result import RunResult, Timings
from factorgraph_loc.model.scoring import MAX_GAP, TICK_GAP, Ticks, check_max_gap, check_tick_gap
from factorgraph_loc.sensors.interfaces import PreparedLog
from factorgraph_loc.sensors.registry import functions, moving
from factorgraph_loc.text import listed
from factorgraph_loc.version import __version__
from factors.se2 import Array

_REHEARSAL = 2.0  # s from the first observation
_REHEARSED: set[tuple[str, tuple[str, ...]]] = set()  # estimators with their sensors, in this process


@dataclass(frozen=True)
class RunConfig:
    """The configuration of a run on a log.

    ``estimator``: its registered name; ``settings``: overrides of its settings. ``sensors``: names of the streams it may use,
    None for those of the rig; ``rssi`` and ``phase`` are optional parts of the reads of ``rfid``. ``prior``: see
    :func:`~factorgraph_loc.experiments.preparation.resolve_prior`. ``seed``: of the estimator's random generator. ``max_gap``
    [s]: the largest interval between estimates that is interpolated for scoring; it changes no estimate. ``tick_gap`` [s]: there
    are no estimates inside longer gaps between measurements.
    """

    estimator: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    sensors: tuple[str, ...] | None = None
    prior: str | None = None
    seed: int = 0
    max_gap: float = MAX_GAP
    tick_gap: float = TICK_GAP


def run(
    log: Log,
    config: RunConfig,
    progress: Callable[[float], None] | None = None,
    watch: Callable[[float, Estimator], None] | None = None,
) -> RunResult:
    """Run an estimator on a log.

    The ticks are at 10 Hz from the prior's time on, except inside long gaps between measurements (``tick_gap``). A tick comes
    after all measurements that arrived up to its time; the estimate after it is the causal one. Odometry older than the prior is
    processed before the estimator is initialized, because its velocity is held; other measurements older than the prior are
    counted as ignored. With an unknown start the ticks begin at the first measurement, and the final trajectory begins at the
    first belief and may be empty. A log with neither start nor reference, and without a map that its sensors observe, begins at
    (0, 0, 0). ``progress`` is called with the fraction done, of which feature extraction, if needed, is the first half. ``watch``
    is called with the time and the estimator after each tick, to inspect its belief.

    Raises InputError if the configuration does not fit the log, RunFailedError if the estimator fails or returns a pose that is
    not finite or a covariance that is not positive definite, with the time and the measurement; see
    :mod:`factorgraph_loc.fusion.guarded`.
    """
    check_max_gap(config.max_gap)
    check_tick_gap(config.tick_gap)
    require_bounds(log)  # the log may have been made by a program
    require_one_span(log)
    sensors = used_sensors(log, config.sensors)
    settings = registry.settings_of(config.estimator, config.settings)
    use, own_map = with_own_map(use_of(log, sensors, config.estimator, settings), config.settings)
    settings = use.settings
    for _, check in functions("check"):
        check(use)
    prior, prior_source = resolve_prior(log, config.prior)
    setup = model_setup.Setup(log.rig, log.world, sensors, np.random.default_rng(config.seed))
    guard = Guard(f"{config.estimator} on {log.name}")
    with guard:
        estimator = registry.create(config.estimator, setup, settings)
    unstated: tuple[str, ...] = ()
    if prior is None and config.prior is None and not findable(log, tuple(log.streams)):
        prior, prior_source = at_origin(log), "origin"
        unstated = (f"{log.name}: has neither a start nor a reference: begins at (0, 0, 0); --prior says where else",)
    if prior is None and not getattr(estimator, "supports_unknown_start", False):
        raise InputError(
            f"{config.estimator} cannot start from an unknown pose on {log.name} with these settings, "
            f"expected a prior {KNOWN}"
        )
    if prior is not None and not prior.has_heading and not (finds_heading(estimator) and findable(log, sensors)):
        raise InputError(
            f"{config.estimator} cannot find an unknown heading on {log.name} with these settings and sensors, "
            f"expected a prior X,Y,HEADING"
        )

    report = progress or (lambda _: None)
    prepared = prepare(use, lambda share: report(0.5 * share))
    before = 0.5 if prepared.images else 0.0
    frame = MapFrame.of(setup, use.modalities, getattr(settings, "landmarks", "known"))
    _rehearse(config, setup, settings, prepared.log, prior)
    ticks = Ticks(_begin(log, sensors, prior), config.tick_gap)
    loop = _CausalRun(
        guard,
        estimator,
        prepared.log,
        sensors,
        prior,
        ticks,
        frame,
        lambda share: report(before + (1.0 - before) * share),
        watch,
    )
    with guard.quiet(), only_new_searched():
        loop.run()
    started = perf_counter()
    with guard.telling("the final trajectory"):
        final = frame.trajectory(sound_trajectory(estimator.trajectory()))
        final_seconds = perf_counter() - started
        diagnostics, learnt = estimator.diagnostics, estimator.learnt()
        if isinstance(estimator, ConcludingEstimator):
            diagnostics = estimator.final_diagnostics()
    told = [(name, of(use, diagnostics, learnt, final)) for name, of in functions("reliability")]
    reliability = {name: one for name, one in told if one is not None}
    versions = _versions()
    effective = {
        "log": log.name,
        "estimator": config.estimator,
        "settings": settings.model_dump(mode="json", exclude_none=True),
        "sensors": list(sensors),
        "prior": prior_source,
        "seed": config.seed,
        "max_gap": config.max_gap,
        "tick_gap": config.tick_gap,
        "rig": log.rig.model_dump(mode="json", exclude_none=True),
        "versions": versions,
    }
    return RunResult(
        log=log.name,
        config=effective,
        t=np.array(loop.told.t),
        poses=np.array(loop.told.poses).reshape(-1, 3),
        covariances=np.array(loop.told.covariances).reshape(-1, 3, 3),
        status=tuple(loop.told.status),
        final=final,
        diagnostics=diagnostics,
        learnt=learnt,
        timings=loop.timings(final_seconds, prepared),
        versions=versions,
        warnings=_once(
            *log.warnings,
            *unstated,
            *own_map,
            *unused(log, sensors),
            *prepared.warnings,
            *(line for _, doubts in functions("doubts") for line in doubts(use, estimator.diagnostics, learnt)),
            *(line for one in reliability.values() for line in one.doubts),
            *never_localized(log, sensors, loop.told.status, final),
            *partly_scored(log, final, config.max_gap),
            *in_bent_map(log, frame, final),
            *with_pauses(log, ticks.skipped, config.tick_gap),
        ),
        reliability=reliability,
    )


def _rehearse(
    config: RunConfig, setup: model_setup.Setup, settings: FileModel, log: Log, prior: PosePrior | None
) -> None:
    """Let an estimator that is thrown away work on the first seconds with observations, so that compiled functions are loaded, or
    compiled, before times are taken. Once in a process for each estimator and its sensors; an error comes again in the run itself.
    """
    kind = config.estimator, setup.sensors
    if kind in _REHEARSED:
        return
    _REHEARSED.add(kind)
    begin = _begin(log, setup.sensors, prior)
    moves = moving(log.streams, "floor", "turn")
    observes = [s for s in log.streams if s in setup.sensors and s not in moves]
    seen = [log.streams[s].t + log.rig.time_offset(s) for s in observes]
    first = min((float(t[t >= begin].min(initial=math.inf)) for t in seen), default=begin)
    guard = Guard(config.estimator)
    with suppress(FglocError), guard, guard.quiet():
        estimator = registry.create(config.estimator, replace(setup, rng=np.random.default_rng(config.seed)), settings)
        ticks = Ticks(begin, config.tick_gap)
        _CausalRun(guard, estimator, log, setup.sensors, prior, ticks, MapFrame(), end=first + _REHEARSAL).run()
        with guard.telling("the final trajectory"):
            estimator.trajectory()


@dataclass
class _CausalRun:
    """The causal part of a run, up to ``end``, in a map with this ``frame``."""

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
    told: CausalEstimates = field(default_factory=CausalEstimates)

    def __post_init__(self) -> None:
        first, self._last = _span(self.log, self.sensors)
        self._start = first if self.prior is None else self.prior.t
        self._initialized = self.prior is None
        self._reported = self._seconds = 0.0
        self._update_t: list[float] = []
        self._update_s: list[float] = []

    def run(self) -> None:
        """Process all measurements and ticks."""
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
        for tick in self.ticks.rest():
            self._tick(tick)
        self._seconds = perf_counter() - started
        self.progress(1.0)

    def timings(self, final_seconds: float, prepared: PreparedLog) -> Timings:
        """The times of the loop, of the preparation, and of the final trajectory."""
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
        joined = getattr(self.estimator, "takes_rows", False)
        steps = self.log.steps(self.sensors) if joined else self.log.measurements(self.sensors)
        return takewhile(lambda m: m.t <= self.end, steps)

    def _reach(self, t: float) -> None:
        """What comes before a measurement at ``t``: the start, and ticks."""
        if not self._initialized and t > self._start:
            self._initialize()
        for tick in self.ticks.before(t):
            self._tick(tick)

    def _move(self, m: Measurement) -> None:
        """Take a row of motion; or some, cut where a tick is due."""
        if not isinstance(m, Rows):
            self._reach(m.t)
            self.guard.process(self.estimator, m)
            return
        times, first = m.times.tolist(), 0
        while first < len(times):
            self._reach(times[first])
            last = max(first + 1, bisect.bisect_right(times, self.ticks.due))
            self.ticks.before(times[last - 1])  # none, but it has come that far
            self.guard.process(self.estimator, m.part(first, last))
            first = last

    def _initialize(self) -> None:
        assert self.prior is not None
        self._initialized = True
        with self.guard.telling("the start", self.prior.t):
            self.estimator.initialize(self.frame.prior(self.prior))

    def _update(self, t: float, measurements: Iterator[Measurement]) -> None:
        started = perf_counter()
        for m in measurements:
            self.guard.process(self.estimator, m)
        with self.guard.telling("the estimate", t):
            sound(self.estimator.estimate())
        self._update_s.append(perf_counter() - started)
        self._update_t.append(t)

    def _tick(self, t: float) -> None:
        with self.guard.telling("the estimate", t):
            e = self.frame.estimate(sound(self.estimator.estimate(t)))
        self.guard.process(self.estimator, Tick(t))
        self.told.add(t, e)
        if self.watch is not None:
            self.watch(t, self.estimator)
        share = (t - self._start) / max(self._last - self._start, 1e-9)
        if share >= self._reported:
            self.progress(share)
            self._reported = share + 0.01


def _begin(log: Log, sensors: tuple[str, ...], prior: PosePrior | None) -> float:
    """The time of the first tick. Raises InputError if there are no measurements from then on."""
    first, last = _span(log, sensors)
    begin = first if prior is None else prior.t
    if not begin <= last:
        raise InputError(f"{log.name}: the prior's time {begin:.3f} s lies after the last measurement at {last:.3f} s")
    return begin


def _span(log: Log, sensors: tuple[str, ...]) -> tuple[float, float]:
    streams = {s: log.streams[s].t for s in sensors if s in log.streams}
    stamps: list[Array] = [t + log.rig.time_offset(s) for s, t in streams.items() if len(t)]
    if not stamps:
        raise InputError(f"{log.name}: has no measurements of {listed(sensors)}")
    return min(float(t.min()) for t in stamps), max(float(t.max()) for t in stamps)


def _once(*warnings: str) -> tuple[str, ...]:
    """The warnings without duplicates."""
    return tuple(dict.fromkeys(warnings))


def _versions() -> dict[str, str]:
    return {
        "factorgraph-loc": __version__,
        "gtsam": importlib.metadata.version("gtsam"),
        "numpy": importlib.metadata.version("numpy"),
        "python": platform.python_version(),
    }


def _peak_memory_mb() -> float:
    # getrusage includes the parent's memory at the fork; the kernel's own figure does not
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return float(status.split("VmHWM:")[1].split()[0]) * 1024 / 1e6
    except (OSError, IndexError):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6
