"""What a run's result depends on, as one key: the log, the configuration, the rule of scoring, the code, the libraries."""

import hashlib
import importlib.metadata
import json
import platform
import time
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.log_source import LogSource
from factorgraph_loc.files import bounded
from factorgraph_loc.files.models import write_text
from factorgraph_loc.model.scoring import RULE
from factorgraph_loc.text import plain

LIBRARIES = ("gtsam", "numpy", "scipy", "opencv-python-headless", "numba")
# parts of the package that no run goes through: a change to the report must not undo a night's work
OUTSIDE = (
    "api.py",
    "cli",
    "calibration",
    "exports",
    "live",
    "mapping",
    "planning",
    "sensors/odometry/calibration",
    "sensors/rfid/calibration",
    "evaluation/inference.py",
    "evaluation/report",
    "experiments/cluster.py",
    "experiments/maps.py",
    "experiments/particles.py",
    "experiments/reporting.py",
)
Kept = TypeVar("Kept", bound=BaseModel)
_UNSETTLED = 2.0  # s: a file that young may change again within the same stamp


def digest_of(content: Any) -> str:
    """The sha256 of plain data, as hexadecimal digits."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@lru_cache
def code_version() -> str:
    """A digest of the source files that a run can go through."""
    package = Path(__file__).parents[1]
    total = hashlib.sha256()
    for root in (package, package.parent / "factors"):
        for file in sorted(root.rglob("*")):
            name = file.relative_to(root).as_posix()
            if file.suffix in (".py", ".npz") and not (root is package and name.startswith(OUTSIDE)):
                total.update(f"{root.name}/{name}\0".encode() + hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()


@lru_cache
def library_versions() -> dict[str, str]:
    """The versions of what computes, by name."""
    return {name: importlib.metadata.version(name) for name in LIBRARIES} | {"python": platform.python_version()}


def run_key(log_digest: str, config: Mapping[str, Any]) -> str:
    """The key of a run: of a log's digest, and its effective configuration as plain data."""
    return digest_of(
        {
            "log": log_digest,
            "config": dict(config),
            "scoring": RULE,
            "code": code_version(),
            "libraries": library_versions(),
        }
    )


def read_cache(file: Path, kind: type[Kept]) -> Kept | None:
    """What was kept; None if it is not there or damaged, for it can be made again."""
    try:
        return kind.model_validate_json(bounded.read_bytes(file, bounded.DATA))
    except (InputError, ValidationError):
        return None


def write_cache(file: Path, content: BaseModel) -> None:
    """Keep it; where it cannot be written, it is made again the next time."""
    with suppress(OSError):
        write_text(file, json.dumps(content.model_dump()))


class _Digests(BaseModel):
    """By path: the size, the time of change and the sha256."""

    files: dict[str, tuple[int, int, str]] = {}


class FileDigests:
    """The sha256 of files; with ``cache``, a JSON file, by path, size and time of change, so that a file is read once."""

    def __init__(self, cache: Path | None) -> None:
        self._cache = cache
        self._new = False
        self._known = ((cache and read_cache(cache, _Digests)) or _Digests()).files

    def of_source(self, source: LogSource) -> str:
        """The digest of what a log is made from; InputError if a file is not there."""
        try:
            found = source.files()
        except OSError as error:  # a folder that may not be looked into
            raise InputError(f"{plain(error.filename)}: cannot be read: {error.strerror}") from error
        files = {name: self.of_file(path) for name, path in found.items()}
        return digest_of({"identity": source.identity(), "files": files})

    def of_file(self, path: Path) -> str:
        """The sha256 of a file; InputError if it cannot be read."""
        try:
            stat = path.stat()
            known = self._known.get(str(path))
            if known is not None and known[:2] == (stat.st_size, stat.st_mtime_ns):
                return known[2]
            with path.open("rb") as file:
                found = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        if time.time() - stat.st_mtime > _UNSETTLED:
            self._known[str(path)] = (stat.st_size, stat.st_mtime_ns, found)
            self._new = True
        return found

    def save(self) -> None:
        """Keep what is new."""
        if self._new and self._cache is not None:
            write_cache(self._cache, _Digests(files=self._known))
            self._new = False


def source_digest(source: LogSource) -> str:
    """The digest of what a log is made from now, every file read; InputError if one is not there."""
    return FileDigests(None).of_source(source)
