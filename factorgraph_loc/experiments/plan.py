"""The runs of an experiment, each with its key, before any of them is made."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.experiment_file import (
    SIMULATION,
    EstimatorEntry,
    Experiment,
    LogEntry,
    canonical,
    nested,
)
from factorgraph_loc.experiments.facts import Facts
from factorgraph_loc.experiments.keys import FileDigests, run_key
from factorgraph_loc.experiments.log_source import LogSource, RecordedSource, SimulatedSource, recorded_sources
from factorgraph_loc.files import nearest
from factorgraph_loc.text import quoted

if TYPE_CHECKING:
    from factorgraph_loc.experiments.run import RunConfig


@dataclass(frozen=True)
class PlannedRun:
    """One run, as plain data that can be sent to other processes.

    ``source``: of the log, whose content has the digest ``log_digest``; ``log``: its name; ``duration`` [s] of it. ``label``: of
    the ``estimator`` with these ``settings``; ``max_gap`` [s]: of scoring; ``tick_gap`` [s]: of the estimates; ``sweep``: what was
    set for this run, by dotted name. ``key``: of its results.
    """

    source: LogSource
    log_digest: str
    log: str
    duration: float
    label: str
    estimator: str
    settings: Mapping[str, Any]
    sensors: tuple[str, ...] | None
    prior: str | None
    seed: int
    max_gap: float
    tick_gap: float
    key: str
    sweep: Mapping[str, Any] = field(default_factory=dict)

    @property
    def shown(self) -> str:
        """What tells it from the others, in words."""
        swept = "".join(f", {key} {value}" for key, value in self.sweep.items())
        return f"{self.log}, {self.label}{swept}, seed {self.seed}"

    @property
    def config(self) -> RunConfig:
        """What is run on the log."""
        from factorgraph_loc.experiments.run import RunConfig  # noqa: PLC0415 - the plan needs no estimator

        return RunConfig(
            self.estimator, self.settings, self.sensors, self.prior, self.seed, self.max_gap, self.tick_gap
        )


@dataclass(frozen=True)
class _PlannedLog:
    source: LogSource
    digest: str
    name: str
    duration: float
    sensors: tuple[str, ...]


def plan(experiment: Experiment, folder: Path, cache: Path, data_root: str | None = None) -> list[PlannedRun]:
    """All runs of an experiment whose paths start from ``folder``; what had to be looked up is kept below ``cache``.

    An estimator is not run again for values of a sweep that do not concern it, and one without randomness only with the first
    seed. InputError, before anything runs, for a log that cannot be read, two logs of one name, settings that are none, a prior
    that is none, or a sensor that no log has.
    """
    digests, facts = FileDigests(cache / "digests.json"), Facts(cache / "facts.json")
    points = experiment.sweep.points()
    runs: list[PlannedRun] = []
    if experiment.prior is not None:
        facts.check_prior(experiment.prior)
    for entry in experiment.estimators:
        for point in points:
            facts.estimator(entry.name, _settings(entry, point))  # a wrong setting is told before logs are read
    met: set[str] = set()
    for point in _unlike(points, (SIMULATION,)):
        logs = [log for entry in experiment.logs for log in _logs(entry, point, folder, data_root, digests, facts)]
        _check(logs, experiment.sensors)
        for log in logs:
            for entry in experiment.estimators:
                concerned = (SIMULATION, entry.shown, entry.name) if _is_simulated(log) else (entry.shown, entry.name)
                for swept in _unlike([p for p in points if _part(p, (SIMULATION,)) == point], concerned):
                    for run in _runs(experiment, log, entry, swept, facts):
                        if f"{run.label} {run.key}" not in met:
                            met.add(f"{run.label} {run.key}")
                            runs.append(run)
    digests.save()
    facts.save()
    return runs


def _runs(
    experiment: Experiment, log: _PlannedLog, entry: EstimatorEntry, point: Mapping[str, Any], facts: Facts
) -> Iterator[PlannedRun]:
    settings = _settings(entry, point)
    estimator = facts.estimator(entry.name, settings)
    for sensors in experiment.sensors:
        for seed in experiment.seeds[:1] if estimator.deterministic else experiment.seeds:
            config = {
                "estimator": entry.name,
                "settings": estimator.effective,
                "sensors": sensors,
                "prior": experiment.prior,
                "seed": seed,
                "max_gap": experiment.max_gap,
                "tick_gap": experiment.tick_gap,
            }
            yield PlannedRun(
                source=log.source,
                log_digest=log.digest,
                log=log.name,
                duration=log.duration,
                label=entry.shown,
                estimator=entry.name,
                settings=settings,
                sensors=sensors,
                prior=experiment.prior,
                seed=seed,
                max_gap=experiment.max_gap,
                tick_gap=experiment.tick_gap,
                key=run_key(log.digest, config),
                sweep=point,
            )


def _logs(
    entry: LogEntry, point: Mapping[str, Any], folder: Path, data_root: str | None, digests: FileDigests, facts: Facts
) -> Iterator[_PlannedLog]:
    sources: Sequence[LogSource]
    if entry.simulate is not None:
        settings = json.loads(canonical(entry.settings))
        for key, value in point.items():
            _merge(settings, nested(key.partition(".")[2], value))
        preset = entry.simulate
        if preset.endswith(".toml"):
            preset = str(folder / preset)
        sources = [SimulatedSource(preset, canonical(settings), seed) for seed in entry.seeds]
    else:
        assert entry.log is not None
        rig, world = (None if name is None else str(folder / name) for name in (entry.rig, entry.world))
        sources = recorded_sources(
            entry.log,
            folder,
            reader=entry.reader,
            options=canonical(entry.options),
            rig=rig,
            world=world,
            data_root=data_root,
        )
    for first in sources:
        for number, found in enumerate(facts.logs(first, digests.of_source(first))):
            source = RecordedSource(**vars(first) | {"number": number}) if isinstance(first, RecordedSource) else first
            yield _PlannedLog(source, digests.of_source(source), found.name, found.duration, found.sensors)


def _settings(entry: EstimatorEntry, point: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of an estimator at a point of the sweep."""
    settings: dict[str, Any] = json.loads(canonical(entry.settings))
    for key, value in _part(point, (entry.shown, entry.name)).items():
        _merge(settings, nested(key.partition(".")[2], value))
    return settings


def _merge(into: dict[str, Any], changes: Mapping[str, Any]) -> None:
    for key, value in changes.items():
        if isinstance(value, Mapping) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        else:
            into[key] = value


def _part(point: Mapping[str, Any], words: Sequence[str]) -> dict[str, Any]:
    """Of a point of a sweep, what concerns ``words``."""
    return {key: value for key, value in point.items() if key.partition(".")[0] in words}


def _unlike(points: Sequence[Mapping[str, Any]], words: Sequence[str]) -> list[dict[str, Any]]:
    """The points, of each only what concerns ``words``, each once."""
    kept: list[dict[str, Any]] = []
    for point in points:
        part = _part(point, words)
        if part not in kept:
            kept.append(part)
    return kept


def _is_simulated(log: _PlannedLog) -> bool:
    return isinstance(log.source, SimulatedSource)


def _check(logs: Sequence[_PlannedLog], sensors: Sequence[tuple[str, ...] | None]) -> None:
    names = [log.name for log in logs]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"two logs are called {twice[0]}, expected different names")
    known = list(dict.fromkeys(sensor for log in logs for sensor in log.sensors))
    for sensor in (one for several in sensors for one in several or ()):
        if sensor not in known:
            raise InputError(f"no log has a sensor {quoted(sensor)}{nearest(sensor, known)}")
