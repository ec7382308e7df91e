"""Keys of runs, and cached facts about logs and estimators for planning.

A key is a digest of everything that a result depends on: log, configuration, code, libraries. Facts are cached because computing
them imports numerical libraries or reads the log.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ValidationError

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.experiment_file import canonical
from factorgraph_loc.experiments.log_source import LogSource
from factorgraph_loc.files import bounded
from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.shipped import readers
from factorgraph_loc.text import plain

if TYPE_CHECKING:
    from factorgraph_loc.model.log import Log

LIBRARIES = ("gtsam", "numpy", "scipy", "opencv-python-headless", "numba")
PACKAGES = (__name__.partition(".")[0], "factors")
_UNSETTLED = 2.0  # s: a younger file may change again without a new modification time


def digest_of(content: Any) -> str:
    """The sha256 of plain data, in hexadecimal digits."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@lru_cache
def code_version() -> str:
    """A digest of the source files of this project."""
    return digest_of_code(Path(__file__).parents[2])


def digest_of_code(root: Path) -> str:
    """The digest of the source files of the packages in the folder ``root``, and of the shipped descriptions of readers."""
    total = hashlib.sha256()
    for package in PACKAGES:
        for file in sorted((root / package).rglob("*")):
            if file.suffix in (".py", ".npz"):
                name = file.relative_to(root).as_posix()
                total.update(f"{name}\0".encode() + hashlib.sha256(file.read_bytes()).digest())
    for name, file in readers().items():
        total.update(f"{name}\0".encode() + hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()


@lru_cache
def library_versions() -> dict[str, str]:
    """The versions of numerical libraries, by name."""
    return {name: importlib.metadata.version(name) for name in LIBRARIES} | {"python": platform.python_version()}


def software_digest() -> str:
    """A digest of the code and the libraries of this process."""
    return digest_of([code_version(), library_versions()])


def run_key(log_digest: str, config: Mapping[str, Any]) -> str:
    """The key of a run, from a log's digest and its effective configuration as plain data."""
    return digest_of({"log": log_digest, "config": dict(config), "software": software_digest()})


class VanishedError(InputError):
    """A log disappeared, or differs from the planned one."""


@lru_cache(maxsize=4)
def load_planned(source: LogSource, digest: str) -> Log:
    """The log of a source that has the ``digest`` of the plan; cached, as consecutive runs use the same log."""
    try:
        now = Facts().digest(source)
    except InputError as error:
        raise VanishedError(f"the log has vanished: {error}") from error
    if now != digest:
        raise VanishedError("the log has changed since the experiment was planned")
    return source.load()


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
    """Facts obtained with code and libraries of this ``version``: size, modification time and sha256 of ``files`` by path,
    ``logs`` by digest, ``estimators`` by name and settings."""

    version: str = ""
    files: dict[str, tuple[int, int, str]] = {}
    logs: dict[str, list[LogFacts]] = {}
    estimators: dict[str, EstimatorFacts] = {}


class Facts:
    """Digests of files, and facts about logs and estimators. A JSON file ``cache`` keeps them for unchanged files, code and
    libraries, so that each file is read once."""

    def __init__(self, cache: Path | None = None) -> None:
        self._cache = cache
        self._known = _Kept() if cache is None else _kept(cache)

    def digest(self, source: LogSource) -> str:
        """The digest of a log's source. Raises InputError if a file is missing."""
        try:
            paths = source.files()
        except OSError as error:  # a folder that must not be read
            raise InputError(f"{plain(error.filename)}: cannot be read: {error.strerror}") from error
        files = {name: self._of_file(path) for name, path in paths.items()}
        return digest_of({"identity": source.identity(), "files": files})

    def _of_file(self, path: Path) -> str:
        """The sha256 of a file. Raises InputError if it cannot be read."""
        try:
            stat = path.stat()
            known = self._known.files.get(str(path))
            if known is not None and known[:2] == (stat.st_size, stat.st_mtime_ns):
                return known[2]
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        if time.time() - stat.st_mtime > _UNSETTLED:
            self._known.files[str(path)] = (stat.st_size, stat.st_mtime_ns, digest)
        return digest

    def logs(self, source: LogSource, digest: str) -> list[LogFacts]:
        """Facts of all logs of a source. Raises InputError as the reader or the simulation's settings do."""
        if digest not in self._known.logs:
            self._known.logs[digest] = [_facts(log) for log in source.load_all()]
        return self._known.logs[digest]

    def estimator(self, name: str, settings: Mapping[str, Any]) -> EstimatorFacts:
        """Facts of an estimator with these settings. Raises InputError for an unknown estimator or invalid settings."""
        key = f"{name} {canonical(settings)}"
        if key not in self._known.estimators:
            self._known.estimators[key] = _of_estimator(name, settings)
        return self._known.estimators[key]

    def save(self) -> None:
        """Write the facts to the cache; errors are ignored."""
        if self._cache is not None:
            with suppress(OSError):
                write_text(self._cache, json.dumps(self._known.model_dump()))


def _kept(cache: Path) -> _Kept:
    """The content of a cache; empty if it is missing, damaged, or of other code or libraries."""
    with suppress(InputError, ValidationError):
        kept = _Kept.model_validate_json(bounded.read_bytes(cache, bounded.DATA))
        if kept.version == software_digest():
            return kept
    return _Kept(version=software_digest())


def _facts(log: Any) -> LogFacts:
    from factorgraph_loc.experiments.preparation import columns_of  # noqa: PLC0415

    first, last = log.span()
    return LogFacts(log.name, last - first, (*log.streams, *columns_of(log.streams)))


def _of_estimator(name: str, settings: Mapping[str, Any]) -> EstimatorFacts:
    from factorgraph_loc.fusion import registry  # noqa: PLC0415

    effective = registry.settings_of(name, settings).model_dump(mode="json")
    return EstimatorFacts(effective, bool(registry.estimator_type(name).deterministic))
