"""Planning of an experiment: it lists all runs with the keys of their results, before any run is executed."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.warned import SIMULATION, SWEEP
from factorgraph_loc.experiments.experiment_file import (
    MOST_RUNS,
    EstimatorEntry,
    Experiment,
    LogEntry,
    Scalar,
    Sweep,
    canonical,
)
from factorgraph_loc.experiments.keys import Facts, LogFacts, load_planned, run_key
from factorgraph_loc.experiments.log_source import LogSource, RecordedSource, SimulatedSource, recorded_sources
from factorgraph_loc.files.data_root import named_path
from factorgraph_loc.files.models import nearest, set_key
from factorgraph_loc.model.scoring import RunConfig, check_prior
from factorgraph_loc.model.sections import kind_of
from factorgraph_loc.text import quoted


@dataclass(frozen=True, kw_only=True)
class PlannedRun(RunConfig):
    """A planned run of an estimator on a log, which can be sent to other processes.

    ``source``: how to load the log. ``log_digest``: hash of its content. ``log``: its name. ``duration`` [s]: of the
    log. ``label``: name of the estimator in the results. ``sweep``: {dotted name: value} of swept settings. ``key``:
    key of the results in the store.
    """

    source: LogSource
    log_digest: str
    log: str
    duration: float
    label: str
    key: str
    sweep: Mapping[str, Any] = field(default_factory=dict)

    @property
    def shown(self) -> str:
        """A description that distinguishes this run from the other runs, for messages."""
        swept = "".join(f", {key} {value}" for key, value in self.sweep.items())
        return f"{self.log}, {self.label}{swept}, seed {self.seed}"

    @property
    def columns(self) -> dict[str, Any]:
        """{name: value} of the first columns of the run's row in the table of results, such as label, log and seed."""
        return {
            "label": self.label,
            "log": self.log,
            "estimator": self.estimator,
            "sensors": None if self.sensors is None else ",".join(self.sensors),
            "prior": self.prior,
            "seed": self.seed,
            **{f"{SWEEP}{key}": value for key, value in self.sweep.items()},
            "key": self.key,
            "duration": self.duration,
        }

    def make(self) -> dict[str, bytes]:
        """Execute the run. Return its files as {file name: content}. Raises VanishedError if the log has changed since
        the experiment was planned, and FglocError if the run fails."""
        from factorgraph_loc.experiments.output import run_files  # noqa: PLC0415
        from factorgraph_loc.experiments.run import run  # noqa: PLC0415

        started = perf_counter()
        log = load_planned(self.source, self.log_digest)
        return run_files(run(log, self), log, started, self.align)


@dataclass(frozen=True)
class _PlannedLog(LogFacts):
    """Properties of a log, how to load it (``source``), and the hash of its content (``digest``)."""

    source: LogSource
    digest: str


def plan(
    experiment: Experiment,
    folder: Path,
    cache: Path,
    data_root: str | None = None,
    *,
    given: Sequence[LogSource] = (),
) -> list[PlannedRun]:
    """Return all planned runs of an experiment.

    ``folder``: paths in the experiment are relative to it. ``cache``: folder for a cache of hashes of files and of
    properties of logs and estimators. ``data_root``: folder of the datasets, None for the environment variable
    FGLOC_DATA. ``given``: sources of logs to use instead of the logs of the experiment.

    Swept settings of one estimator do not multiply the runs of other estimators. Deterministic estimators run only with
    the first seed.

    Raises InputError for an unreadable log, two logs with the same name, invalid settings or an invalid prior. It is
    also raised for a sensor that no log has, and for more than :data:`MOST_RUNS` runs.
    """
    facts = Facts(cache / "facts.json")
    experiment = _placed(experiment, folder, data_root)
    sweep = experiment.sweep
    check_prior(experiment.prior)
    recorded: dict[int, Sequence[LogSource]] = {
        place: given[place : place + 1] or _recorded(entry, folder, data_root)
        for place, entry in enumerate(experiment.logs)
        if entry.simulate is None
    }
    _check_count(_count(experiment, sum(map(len, recorded.values())), facts), experiment)
    for entry in experiment.estimators:
        for swept in sweep.points(entry.shown, entry.name):
            facts.estimator(entry.name, _settings(entry, swept))  # report a wrong setting before logs are read
    try:
        runs = _all_runs(experiment, recorded, facts)
    finally:  # facts are kept even if the planning is interrupted
        facts.save()
    return runs


def _all_runs(experiment: Experiment, recorded: Mapping[int, Sequence[LogSource]], facts: Facts) -> list[PlannedRun]:
    """Return all runs of an experiment. ``recorded``: {index in ``experiment.logs``: sources of recorded logs}."""
    sweep = experiment.sweep
    of_others = {entry.shown: sweep.points(entry.shown, entry.name) for entry in experiment.estimators}
    of_simulated = {entry.shown: _by_simulation(sweep, entry) for entry in experiment.estimators}
    runs: dict[str, PlannedRun] = {}
    of_recorded = {place: [*_logs(sources, facts)] for place, sources in recorded.items()}
    for number, point in enumerate(sweep.points(SIMULATION)):
        simulated = tuple(point.values())
        logs = [
            log
            for place, entry in enumerate(experiment.logs)
            for log in (of_recorded[place] if place in of_recorded else _logs(_simulated(entry, point), facts))
        ]
        _check(logs, experiment.sensors)
        for log in (
            logs if number == 0 else filter(_is_simulated, logs)
        ):  # sweeps of the simulation do not apply to recorded logs
            for entry in experiment.estimators:
                concerns = of_simulated[entry.shown][simulated] if _is_simulated(log) else of_others[entry.shown]
                for swept in concerns:
                    for run in _runs(experiment, log, entry, swept, facts):
                        runs.setdefault(f"{run.label} {run.key}", run)
                _check_count(len(runs), experiment)
    return list(runs.values())


def _count(experiment: Experiment, recorded: int, facts: Facts) -> int:
    """Return a lower bound for the number of runs. ``recorded``: number of sources of recorded logs."""
    simulated = sum(len(entry.seeds) for entry in experiment.logs if entry.simulate is not None)
    total = 0
    for entry in experiment.estimators:
        words = (entry.shown, entry.name)
        points = experiment.sweep.points
        logs = simulated * len(points(SIMULATION, *words)) + recorded * len(points(*words))
        seeds = 1 if facts.estimator(entry.name, {}).deterministic else len(experiment.seeds)
        total += logs * seeds * len(experiment.sensors)
    return total


def _check_count(count: int, experiment: Experiment) -> None:
    """Raise InputError if ``count``, the number of runs of the ``experiment``, is above :data:`MOST_RUNS`."""
    if count > MOST_RUNS:
        raise InputError(
            f"the experiment {experiment.name} plans more than {MOST_RUNS:,} runs: use fewer logs, seeds or swept values"
        )


def _by_simulation(sweep: Sweep, entry: EstimatorEntry) -> dict[tuple[Any, ...], list[dict[str, Scalar]]]:
    """Return the combinations of swept settings of an estimator and of the simulation, grouped by the settings of the
    simulation. The result is {values of the swept settings of the simulation: combinations}. A combination is {dotted
    name: value}."""
    points: dict[tuple[Any, ...], list[dict[str, Scalar]]] = {}
    for swept in sweep.points(SIMULATION, entry.shown, entry.name):
        points.setdefault(tuple(_part(swept, (SIMULATION,)).values()), []).append(swept)
    return points


def _runs(
    experiment: Experiment, log: _PlannedLog, entry: EstimatorEntry, point: Mapping[str, Any], facts: Facts
) -> Iterator[PlannedRun]:
    """Yield the runs of an estimator on a log, one per set of sensors and seed. ``point``: {swept setting: value}."""
    settings = _settings(entry, point)
    estimator = facts.estimator(entry.name, settings)
    for sensors in experiment.sensors:
        for seed in experiment.seeds[:1] if estimator.deterministic else experiment.seeds:
            config = {
                "estimator": entry.name,
                "settings": settings,
                "sensors": sensors,
                "seed": seed,
                **{name: getattr(experiment, name) for name in ("prior", "max_gap", "tick_gap", "align")},
            }
            yield PlannedRun(
                **config,
                source=log.source,
                log_digest=log.digest,
                log=log.name,
                duration=log.duration,
                label=entry.shown,
                key=run_key(log.digest, config | {"settings": estimator.effective}),
                sweep=point,
            )


def _placed(experiment: Experiment, folder: Path, data_root: str | None) -> Experiment:
    """Return the experiment with the names of its rigs, maps and simulations replaced by paths."""

    def placed(entry: LogEntry) -> LogEntry:
        named = {"rig": entry.rig, "world": entry.world}
        if entry.simulate is not None and entry.simulate.endswith(".toml"):
            named["simulate"] = entry.simulate
        paths = {k: str(named_path(folder, v, "logs", data_root)) for k, v in named.items() if v is not None}
        return entry.model_copy(update=paths)

    return experiment.model_copy(update={"logs": tuple(placed(entry) for entry in experiment.logs)})


def _recorded(entry: LogEntry, folder: Path, data_root: str | None) -> list[RecordedSource]:
    """Return the sources of an entry with recorded logs."""
    assert entry.log is not None
    return recorded_sources(
        entry.log,
        folder,
        reader=entry.reader,
        options=canonical(entry.options),
        rig=entry.rig,
        world=entry.world,
        data_root=data_root,
    )


def _simulated(entry: LogEntry, point: Mapping[str, Any]) -> list[SimulatedSource]:
    """Return a source of simulated logs for each seed of an ``entry``. ``point``: {swept setting: value}."""
    assert entry.simulate is not None
    settings = json.loads(canonical(entry.settings))
    for key, value in point.items():
        set_key(settings, key.partition(".")[2], value, "the sweep")
    return [SimulatedSource(entry.simulate, canonical(settings), seed) for seed in entry.seeds]


def _logs(sources: Sequence[LogSource], facts: Facts) -> Iterator[_PlannedLog]:
    """Yield all logs of several sources."""
    for first in sources:
        for number, log in enumerate(facts.logs(first, facts.digest(first))):
            source = RecordedSource(**vars(first) | {"number": number}) if isinstance(first, RecordedSource) else first
            yield _PlannedLog(**vars(log), source=source, digest=facts.digest(source))


def _settings(entry: EstimatorEntry, point: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of an estimator with its swept values. ``point``: {dotted name: value} of swept settings."""
    settings: dict[str, Any] = json.loads(canonical(entry.settings))
    for key, value in _part(point, (entry.shown, entry.name)).items():
        set_key(settings, key.partition(".")[2], value, "the sweep")
    return settings


def _part(point: Mapping[str, Any], words: Sequence[str]) -> dict[str, Any]:
    """Return the swept settings in ``point`` {dotted name: value} with a name that starts with one of ``words``."""
    return {key: value for key, value in point.items() if key.partition(".")[0] in words}


def _is_simulated(log: _PlannedLog) -> bool:
    return isinstance(log.source, SimulatedSource)


def _check(logs: Sequence[_PlannedLog], sensors: Sequence[tuple[str, ...] | None]) -> None:
    """Raise InputError if two logs have the same name, or if no log has one of the ``sensors``."""
    names = [log.name for log in logs]
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise InputError(f"two logs are called {twice[0]}, expected different names")
    known = list(dict.fromkeys(name for log in logs for sensor in log.sensors for name in (sensor, kind_of(sensor))))
    for sensor in (candidate for several in sensors for candidate in several or ()):
        if sensor not in known:
            raise InputError(f"no log has a sensor {quoted(sensor)}{nearest(sensor, known)}")
