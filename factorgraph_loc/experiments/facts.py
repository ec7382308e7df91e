"""What planning must know of logs and estimators, kept in a file: to look it up takes numerical libraries, or a log's reading."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from factorgraph_loc.experiments.experiment_file import canonical
from factorgraph_loc.experiments.keys import code_version, digest_of, library_versions, read_cache, write_cache
from factorgraph_loc.experiments.log_source import LogSource


@dataclass(frozen=True)
class LogFacts:
    """The ``name`` of a log, its ``duration`` [s], and the ``sensors`` that a run of it can use."""

    name: str
    duration: float
    sensors: tuple[str, ...]


@dataclass(frozen=True)
class EstimatorFacts:
    """The ``effective`` settings of an estimator as plain data, and whether it uses no randomness."""

    effective: Mapping[str, Any]
    deterministic: bool


class Facts:
    """Facts by what they are about, kept in ``cache`` as long as code and libraries are the same."""

    def __init__(self, cache: Path) -> None:
        self._cache = cache
        self._version = digest_of([code_version(), library_versions()])
        kept = read_cache(cache)
        known = kept.get("facts") if kept.get("version") == self._version else None
        self._known: dict[str, Any] = known if isinstance(known, dict) else {}
        self._estimators: dict[str, EstimatorFacts] = {}
        self._new = False

    def logs(self, source: LogSource, digest: str) -> list[LogFacts]:
        """Of all logs that a source stands for; InputError as of the reader, or of the simulation's settings."""
        found = self._known.get(digest)
        if found is None:
            found = self._keep(digest, [asdict(_facts(log)) for log in source.load_all()])
        return [LogFacts(one["name"], one["duration"], tuple(one["sensors"])) for one in found]

    def estimator(self, name: str, settings: Mapping[str, Any]) -> EstimatorFacts:
        """Of an estimator with these settings; InputError if there is none, or if they are none of it."""
        key = f"{name} {canonical(settings)}"
        if key not in self._estimators:
            found = self._known.get(key) or self._keep(key, asdict(_of_estimator(name, settings)))
            self._estimators[key] = EstimatorFacts(found["effective"], found["deterministic"])
        return self._estimators[key]

    def check_prior(self, prior: str) -> None:
        """InputError for a prior that is none."""
        if f"prior {prior}" not in self._known:
            from factorgraph_loc.experiments.prior import check_prior  # noqa: PLC0415

            check_prior(prior)
            self._keep(f"prior {prior}", True)

    def save(self) -> None:
        """Keep what is new."""
        if self._new:
            write_cache(self._cache, {"version": self._version, "facts": self._known})
            self._new = False

    def _keep(self, key: str, value: Any) -> Any:
        self._known[key], self._new = value, True
        return value


def _facts(log: Any) -> LogFacts:
    from factorgraph_loc.experiments.run import OF_READS  # noqa: PLC0415

    first, last = log.span()
    return LogFacts(log.name, last - first, (*log.streams, *(OF_READS if "rfid" in log.streams else ())))


def _of_estimator(name: str, settings: Mapping[str, Any]) -> EstimatorFacts:
    from factorgraph_loc.estimators import registry  # noqa: PLC0415

    effective = registry.settings_of(name, settings).model_dump(mode="json")
    module, kind, _ = registry.ESTIMATORS[name]
    made = getattr(importlib.import_module(f"factorgraph_loc.estimators.{module}"), kind)
    return EstimatorFacts(effective, bool(made.deterministic))
