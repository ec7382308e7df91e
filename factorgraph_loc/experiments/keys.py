"""Keys of runs, and cached facts about logs and estimators, which the planning of an experiment needs.

The key of a run is a hash of all inputs of its results: log, configuration, code and libraries. A fact is for instance
the duration of a log. Facts are cached, because their computation reads the log or imports numerical libraries.
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
_UNSETTLED = 2.0  # s; a file modified less than this time ago is not cached, because clocks of file systems are coarse


def digest_of(content: Any) -> str:
    """Return the sha256 of ``content``, which JSON can represent, as hexadecimal digits."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@lru_cache
def code_version() -> str:
    """Return a hash of the source files of this project."""
    return digest_of_code(Path(__file__).parents[2])


def digest_of_code(root: Path) -> str:
    """Return a hash of the source files of this project's packages below ``root``, and of descriptions of readers."""
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
    """Return {name: version} of the numerical libraries and of Python."""
    return {name: importlib.metadata.version(name) for name in LIBRARIES} | {"python": platform.python_version()}


def software_digest() -> str:
    """Return a hash of the code and the library versions of this process."""
    return digest_of([code_version(), library_versions()])


def run_key(log_digest: str, config: Mapping[str, Any]) -> str:
    """Return the key of a run: a hash of its log, its configuration and the software.

    ``log_digest``: hash of the log. ``config``: the configuration of the run, including defaults.
    """
    return digest_of({"log": log_digest, "config": dict(config), "software": software_digest()})


class VanishedError(InputError):
    """A log does not exist any more, or its content has changed since the experiment was planned."""


@lru_cache(maxsize=4)
def load_planned(source: LogSource, digest: str) -> Log:
    """Return the log of a source. The last logs are cached, because consecutive runs often use the same log.

    ``digest``: hash of the log when the experiment was planned. Raises VanishedError if the log is missing or changed.
    """
    try:
        now = Facts().digest(source)
    except InputError as error:
        raise VanishedError(f"the log cannot be read any more: {error}") from error
    if now != digest:
        raise VanishedError("the log has changed since the experiment was planned")
    return source.load()


@dataclass(frozen=True)
class LogFacts:
    """Properties of a log: its ``name``, its ``duration`` [s], and the names of its ``sensors``."""

    name: str
    duration: float
    sensors: tuple[str, ...]


@dataclass(frozen=True)
class EstimatorFacts:
    """Properties of an estimator. ``effective``: all its settings with defaults, {key: value}. ``deterministic``: True
    if it uses no random numbers."""

    effective: Mapping[str, Any]
    deterministic: bool


class _Kept(BaseModel):
    """The content of a cache of hashes of files, and of properties of logs and estimators.

    ``version``: hash of the code and libraries that computed them. ``files``: by path, the size, modification time and
    sha256 of a file. ``logs``: by hash of a source, properties of its logs. ``estimators``: by name and settings as
    text, properties of an estimator.
    """

    version: str = ""
    files: dict[str, tuple[int, int, str]] = {}
    logs: dict[str, list[LogFacts]] = {}
    estimators: dict[str, EstimatorFacts] = {}


class Facts:
    """Computes hashes of files, and properties of logs and estimators.

    ``cache``: a JSON file of stored values, or None. They are used again if files, code and libraries are unchanged.
    """

    def __init__(self, cache: Path | None = None) -> None:
        self._cache = cache
        self._known = _Kept() if cache is None else _kept(cache)

    def digest(self, source: LogSource) -> str:
        """Return the hash of the source of a log, including its files. Raises InputError if a file is missing."""
        try:
            paths = source.files()
        except OSError as error:  # no permission to read a folder
            raise InputError(f"{plain(error.filename)}: cannot be read: {error.strerror}") from error
        files = {name: self._of_file(path) for name, path in paths.items()}
        return digest_of({"identity": source.identity(), "files": files})

    def _of_file(self, path: Path) -> str:
        """Return the sha256 of a file. Raises InputError if it cannot be read."""
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
        """Return properties of all logs of a source. ``digest``: hash of the source. Raises InputError if loading
        fails."""
        if digest not in self._known.logs:
            self._known.logs[digest] = [_facts(log) for log in source.load_all()]
        return self._known.logs[digest]

    def estimator(self, name: str, settings: Mapping[str, Any]) -> EstimatorFacts:
        """Return the properties of the estimator ``name`` with ``settings``. Raises InputError if either is invalid."""
        key = f"{name} {canonical(settings)}"
        if key not in self._known.estimators:
            self._known.estimators[key] = _of_estimator(name, settings)
        return self._known.estimators[key]

    def save(self) -> None:
        """Write all values to the cache, if there is one. Errors of writing are ignored."""
        if self._cache is not None:
            with suppress(OSError):
                write_text(self._cache, json.dumps(self._known.model_dump()))


def _kept(cache: Path) -> _Kept:
    """Return the content of a cache. It is empty if the file is missing, damaged, or from other code or libraries."""
    with suppress(InputError, ValidationError):
        kept = _Kept.model_validate_json(bounded.read_bytes(cache, bounded.DATA))
        if kept.version == software_digest():
            return kept
    return _Kept(version=software_digest())


def _facts(log: Any) -> LogFacts:
    """Return the name, duration and sensors of a loaded log."""
    from factorgraph_loc.experiments.preparation import columns_of  # noqa: PLC0415

    first, last = log.span()
    return LogFacts(log.name, last - first, (*log.streams, *columns_of(log.streams)))


def _of_estimator(name: str, settings: Mapping[str, Any]) -> EstimatorFacts:
    """Return the properties of an estimator. This imports the estimator, which takes time."""
    from factorgraph_loc.fusion import registry  # noqa: PLC0415

    effective = registry.settings_of(name, settings).model_dump(mode="json")
    return EstimatorFacts(effective, bool(registry.estimator_type(name).deterministic))
