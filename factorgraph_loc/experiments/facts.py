"""Cached facts about logs and estimators for planning, as obtaining them requires numerical libraries or reading the log."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from factorgraph_loc.experiments.experiment_file import canonical
from factorgraph_loc.experiments.keys import code_version, digest_of, library_versions, read_cache, write_cache
from factorgraph_loc.experiments.log_source import LogSource


@dataclass(frozen=True)
class LogFacts:
    """The ``name`` of a log, its ``duration`` [s], and the ``sensors`` available to a run."""

    name: str
    duration: float
    sensors: tuple[str, ...]


@dataclass(frozen=True)
class EstimatorFacts:
    """The ``effective`` settings of an estimator as plain data, and whether it is deterministic."""

    effective: Mapping[str, Any]
    deterministic: bool


class _Kept(BaseModel):
    """Facts obtained with code and libraries of this ``version``: ``logs`` by digest, ``estimators`` by name and settings, and
    valid ``priors``."""

    version: str
    logs: dict[str, list[LogFacts]] = {}
    estimators: dict[str, EstimatorFacts] = {}
    priors: list[str] = []


class Facts:
    """Facts with a file ``cache``, valid for unchanged code and libraries."""

    def __init__(self, cache: Path) -> None:
        self._cache = cache
        version = digest_of([code_version(), library_versions()])
        kept = read_cache(cache, _Kept)
        self._known = kept if kept is not None and kept.version == version else _Kept(version=version)
        self._new = False

    def logs(self, source: LogSource, digest: str) -> list[LogFacts]:
        """Facts of all logs of a source. Raises InputError as the reader or the simulation's settings do."""
        if digest not in self._known.logs:
            self._known.logs[digest], self._new = [_facts(log) for log in source.load_all()], True
        return self._known.logs[digest]

    def knows(self, digest: str) -> bool:
        """Whether the logs of that digest are cached."""
        return digest in self._known.logs

    def estimator(self, name: str, settings: Mapping[str, Any]) -> EstimatorFacts:
        """Facts of an estimator with these settings. Raises InputError for an unknown estimator or invalid settings."""
        key = f"{name} {canonical(settings)}"
        if key not in self._known.estimators:
            self._known.estimators[key], self._new = _of_estimator(name, settings), True
        return self._known.estimators[key]

    def check_prior(self, prior: str) -> None:
        """Raise InputError for an invalid prior."""
        if prior not in self._known.priors:
            from factorgraph_loc.experiments.prior import check_prior  # noqa: PLC0415

            check_prior(prior)
            self._known.priors.append(prior)
            self._new = True

    def save(self) -> None:
        """Save new facts."""
        if self._new:
            write_cache(self._cache, self._known)
            self._new = False


def _facts(log: Any) -> LogFacts:
    from factorgraph_loc.experiments.preparation import columns_of  # noqa: PLC0415

    first, last = log.span()
    return LogFacts(log.name, last - first, (*log.streams, *columns_of(log.streams)))


def _of_estimator(name: str, settings: Mapping[str, Any]) -> EstimatorFacts:
    from factorgraph_loc.fusion import registry  # noqa: PLC0415

    effective = registry.settings_of(name, settings).model_dump(mode="json")
    return EstimatorFacts(effective, bool(registry.estimator_type(name).deterministic))
