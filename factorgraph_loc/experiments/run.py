"""A run of an estimator on a log: preparation, the main loop over the measurements, and the final trajectory."""

import importlib.metadata
import math
import platform
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

import numpy as np

from factorgraph_loc.errors import FglocError, InputError
from factorgraph_loc.experiments.causal_run import CausalRun, rare_garbage_collection, span_of
from factorgraph_loc.experiments.doubts import map_error_warning, never_localized, partly_scored, with_pauses
from factorgraph_loc.experiments.preparation import (
    SET_PRIOR,
    at_origin,
    checked_use,
    resolve_prior,
    unused,
    use_of,
    used_sensors,
)
from factorgraph_loc.files.models import FileModel
from factorgraph_loc.fusion import registry
from factorgraph_loc.fusion.base import ConcludingEstimator, Estimator, finds_heading
from factorgraph_loc.fusion.guarded import Guard, sound_trajectory
from factorgraph_loc.io.checks import require_bounds, require_one_span
from factorgraph_loc.model import setup as model_setup
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import TURN
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.scoring import RunConfig, Ticks, check_max_gap, check_tick_gap
from factorgraph_loc.model.setup import MapFrame
from factorgraph_loc.sensors.camera.use import PreparedLog, prepare
from factorgraph_loc.sensors.interfaces import Ending, Use
from factorgraph_loc.sensors.registry import detecting, functions, moving
from factorgraph_loc.text import Notice, notice
from factorgraph_loc.version import __version__

_REHEARSAL = 2.0  # s; a rehearsal (see _rehearse) ends this long after the first observation
_REHEARSED: set[tuple[str, tuple[str, ...]]] = set()  # estimators and sensors that this process has rehearsed


def run(
    log: Log,
    config: RunConfig,
    progress: Callable[[float], None] | None = None,
    watch: Callable[[float, Estimator], None] | None = None,
) -> RunResult:
    """Run an estimator on a log, and return the estimated trajectories with diagnostics and warnings.

    ``config``: estimator, settings and sensors. ``progress``: called with the completed fraction. If features are
    extracted from images, this is the first half. ``watch``: called with the time [s] and the estimator after each
    tick, for instance to inspect its belief.

    Causal estimates are recorded at ticks. Ticks are at 10 Hz from the time of the prior on, except inside gaps between
    measurements longer than ``config.tick_gap``. The estimator processes all measurements that arrive up to a tick
    before the estimate is recorded. Odometry older than the prior determines the initial velocity. Other measurements
    older than the prior are counted as ignored.

    With an unknown start, ticks begin at the first measurement. The final trajectory begins at the first estimate and
    may be empty. A log starts at (0, 0, 0) if it has no start, no reference, and no map that its sensors observe.

    Raises InputError if the configuration does not fit the log. Raises RunFailedError if the estimator fails, or if a
    pose or a covariance is invalid; see :mod:`factorgraph_loc.fusion.guarded`.
    """
    use = _use(log, config)
    stated = resolve_prior(log, config.prior)
    setup = model_setup.Setup(log.rig, log.world, use.sensors, np.random.default_rng(config.seed))
    guard = Guard(f"{config.estimator} on {log.name}")
    with guard:
        estimator = registry.create(config.estimator, setup, use.settings)
    start = _start(use, config, estimator, *stated)

    report = progress or (lambda _: None)
    prepared = prepare(use, lambda share: report(0.5 * share))
    prepared_share = 0.5 if prepared.images else 0.0
    frame = MapFrame.of(setup, use.modalities, getattr(use.settings, "landmarks", "known"))
    _rehearse(config, setup, use.settings, prepared.log, start.prior)
    ticks = Ticks(_begin(log, use.sensors, start.prior), config.tick_gap)
    causal = CausalRun(
        guard,
        estimator,
        prepared.log,
        use.sensors,
        start.prior,
        ticks,
        frame,
        lambda share: report(prepared_share + (1.0 - prepared_share) * share),
        watch,
    )
    with guard.quiet(), rare_garbage_collection():
        causal.run()
    return _result(use, config, start, prepared, causal, *_ended(guard, estimator, frame))


def _use(log: Log, config: RunConfig) -> Use:
    """Return the log, sensors and settings of a run. Raises InputError if the log or the configuration is invalid."""
    check_max_gap(config.max_gap)
    check_tick_gap(config.tick_gap)
    require_bounds(log)  # no reader has checked a log that was made by a program
    require_one_span(log)
    sensors = used_sensors(log, config.sensors)
    settings = registry.settings_of(config.estimator, config.settings)
    return checked_use(use_of(log, sensors, config.estimator, settings, config.settings))


class _Start(NamedTuple):
    """The start of a run: its ``prior`` (None if the start is unknown), the name of the ``source``, and warnings."""

    prior: PosePrior | None
    source: str
    warnings: tuple[Notice, ...] = ()


def _start(use: Use, config: RunConfig, estimator: Estimator, prior: PosePrior | None, source: str) -> _Start:
    """Return the start of a run, after a check that the estimator can use it. ``prior``: the prior of the start pose,
    None if the start is unknown. ``source``: the name of its source, such as "log". Raises InputError if the estimator
    cannot start from an unknown pose or an unknown heading."""
    log = use.log
    if prior is None and config.prior is None and not detecting(log.world, log.streams):
        sentence = "{log}: has neither a start nor a reference: begins at (0, 0, 0); set --prior for another start"
        return _Start(at_origin(log), "origin", (notice("no_start", sentence, log.name),))
    if prior is None and not getattr(estimator, "supports_unknown_start", False):
        raise InputError(
            f"{config.estimator} cannot start from an unknown pose on {log.name} with these settings: "
            f"{SET_PRIOR} 'reference', 'log' or 'X,Y,HEADING'"
        )
    finds = finds_heading(estimator) and detecting(log.world, use.sensors)
    if prior is not None and not prior.has_heading and not finds:
        raise InputError(
            f"{config.estimator} cannot find an unknown heading on {log.name} with these settings and sensors: "
            f"{SET_PRIOR} 'X,Y,HEADING'"
        )
    return _Start(prior, source)


def _ended(guard: Guard, estimator: Estimator, frame: MapFrame) -> tuple[Ending, float]:
    """Return the final results of an estimator, and the computing time [s] of its final trajectory."""
    started = perf_counter()
    with guard.computing("the final trajectory"):
        final = frame.trajectory(sound_trajectory(estimator.trajectory()))
        seconds = perf_counter() - started
        diagnostics, learnt = estimator.diagnostics, estimator.learnt()
        if isinstance(estimator, ConcludingEstimator):
            diagnostics = estimator.final_diagnostics()
    return Ending(estimator.diagnostics, diagnostics, learnt, final), seconds


def _result(
    use: Use,
    config: RunConfig,
    start: _Start,
    prepared: PreparedLog,
    causal: CausalRun,
    end: Ending,
    final_seconds: float,
) -> RunResult:
    """Return the result of a run, with its effective configuration and all warnings.

    ``causal``: the finished main loop. ``end``: the final results. ``final_seconds``: computing time of the trajectory.
    """
    log = use.log
    reviews = {name: review(use, end) for name, review in functions("review")}
    reliability = {name: result.reliability for name, result in reviews.items() if result.reliability is not None}
    effective = {
        "log": log.name,
        "estimator": config.estimator,
        "settings": use.settings.model_dump(mode="json", exclude_none=True),
        "sensors": list(use.sensors),
        "prior": start.source,
        "seed": config.seed,
        "max_gap": config.max_gap,
        "tick_gap": config.tick_gap,
        "rig": log.rig.model_dump(mode="json", exclude_none=True),
        "versions": _versions(),
    }
    warnings = (
        *log.warnings,
        *start.warnings,
        *use.warnings,
        *unused(log, use.sensors),
        *prepared.warnings,
        *(warning for result in reviews.values() for warning in result.warnings),
        *never_localized(log, use.sensors, causal.estimates.status, end.final),
        *partly_scored(log, end.final, config.max_gap),
        *map_error_warning(log, causal.frame, end.final),
        *with_pauses(log, causal.ticks.skipped, config.tick_gap),
    )
    return RunResult(
        log=log.name,
        config=effective,
        t=np.array(causal.estimates.t),
        poses=np.array(causal.estimates.poses).reshape(-1, 3),
        covariances=np.array(causal.estimates.covariances).reshape(-1, 3, 3),
        status=tuple(causal.estimates.status),
        doubts_model=tuple(causal.estimates.doubts_model),
        final=end.final,
        diagnostics=end.final_diagnostics,
        learnt=end.learnt,
        timings=causal.timings(final_seconds, prepared),
        warnings=tuple(dict.fromkeys(warnings)),
        reliability=reliability,
    )


def _rehearse(
    config: RunConfig, setup: model_setup.Setup, settings: FileModel, log: Log, prior: PosePrior | None
) -> None:
    """Run an estimator on the beginning of a log. This loads compiled functions before computing times are measured.

    A process does this once for each estimator and set of sensors. Errors are ignored, because the run repeats them.
    """
    kind = config.estimator, setup.sensors
    if kind in _REHEARSED:
        return
    _REHEARSED.add(kind)
    begin = _begin(log, setup.sensors, prior)
    moves = moving(log.streams, TURN)
    observes = [s for s in log.streams if s in setup.sensors and s not in moves]
    stamps = [log.streams[s].t + log.rig.time_offset(s) for s in observes]
    first = min((float(t[t >= begin].min(initial=math.inf)) for t in stamps), default=begin)
    guard = Guard(config.estimator)
    with suppress(FglocError), guard, guard.quiet():
        estimator = registry.create(config.estimator, replace(setup, rng=np.random.default_rng(config.seed)), settings)
        ticks = Ticks(begin, config.tick_gap)
        CausalRun(guard, estimator, log, setup.sensors, prior, ticks, MapFrame(), end=first + _REHEARSAL).run()
        with guard.computing("the final trajectory"):
            estimator.trajectory()


def _begin(log: Log, sensors: tuple[str, ...], prior: PosePrior | None) -> float:
    """Return the time [s] of the first tick. Raises InputError if it is after the last measurement."""
    first, last = span_of(log, sensors)
    begin = first if prior is None else prior.t
    if not begin <= last:
        raise InputError(f"{log.name}: the prior's time {begin:.3f} s lies after the last measurement at {last:.3f} s")
    return begin


def _versions() -> dict[str, str]:
    """Return the versions of this package, of Python, and of two libraries, by name."""
    return {
        "factorgraph-loc": __version__,
        "gtsam": importlib.metadata.version("gtsam"),
        "numpy": importlib.metadata.version("numpy"),
        "python": platform.python_version(),
    }
