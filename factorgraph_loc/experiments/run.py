"""One run of an estimator on a log: process measurements in the order of arrival, and store and time the estimates."""

import importlib.metadata
import math
import platform
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np

from factorgraph_loc.errors import FglocError, InputError
from factorgraph_loc.experiments.causal_run import CausalRun, only_new_searched, span_of
from factorgraph_loc.experiments.doubts import in_bent_map, never_localized, partly_scored, with_pauses
from factorgraph_loc.experiments.preparation import (
    KNOWN,
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
from factorgraph_loc.model.scoring import MAX_GAP, TICK_GAP, Ticks, check_max_gap, check_tick_gap
from factorgraph_loc.sensors.camera.use import MapFrame, prepare
from factorgraph_loc.sensors.interfaces import Ending
from factorgraph_loc.sensors.registry import detecting, functions, moving
from factorgraph_loc.version import __version__

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
    use = checked_use(use_of(log, sensors, config.estimator, settings, config.settings))
    settings = use.settings
    prior, prior_source = resolve_prior(log, config.prior)
    setup = model_setup.Setup(log.rig, log.world, sensors, np.random.default_rng(config.seed))
    guard = Guard(f"{config.estimator} on {log.name}")
    with guard:
        estimator = registry.create(config.estimator, setup, settings)
    unstated: tuple[str, ...] = ()
    if prior is None and config.prior is None and not detecting(log.world, log.streams):
        prior, prior_source = at_origin(log), "origin"
        unstated = (f"{log.name}: has neither a start nor a reference: begins at (0, 0, 0); --prior says where else",)
    if prior is None and not getattr(estimator, "supports_unknown_start", False):
        raise InputError(
            f"{config.estimator} cannot start from an unknown pose on {log.name} with these settings, "
            f"expected a prior {KNOWN}"
        )
    if prior is not None and not prior.has_heading and not (finds_heading(estimator) and detecting(log.world, sensors)):
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
    loop = CausalRun(
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
    ending = Ending(estimator.diagnostics, diagnostics, learnt, final)
    reviews = {name: review(use, ending) for name, review in functions("review")}
    reliability = {name: one.reliability for name, one in reviews.items() if one.reliability is not None}
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
            *use.warnings,
            *unused(log, sensors),
            *prepared.warnings,
            *(line for one in reviews.values() for line in one.warnings),
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
    moves = moving(log.streams, TURN)
    observes = [s for s in log.streams if s in setup.sensors and s not in moves]
    seen = [log.streams[s].t + log.rig.time_offset(s) for s in observes]
    first = min((float(t[t >= begin].min(initial=math.inf)) for t in seen), default=begin)
    guard = Guard(config.estimator)
    with suppress(FglocError), guard, guard.quiet():
        estimator = registry.create(config.estimator, replace(setup, rng=np.random.default_rng(config.seed)), settings)
        ticks = Ticks(begin, config.tick_gap)
        CausalRun(guard, estimator, log, setup.sensors, prior, ticks, MapFrame(), end=first + _REHEARSAL).run()
        with guard.telling("the final trajectory"):
            estimator.trajectory()


def _begin(log: Log, sensors: tuple[str, ...], prior: PosePrior | None) -> float:
    """The time of the first tick. Raises InputError if there are no measurements from then on."""
    first, last = span_of(log, sensors)
    begin = first if prior is None else prior.t
    if not begin <= last:
        raise InputError(f"{log.name}: the prior's time {begin:.3f} s lies after the last measurement at {last:.3f} s")
    return begin


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
