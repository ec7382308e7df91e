"""Store of the results of runs on disk. Each run has a folder, named by its key, which is either complete or missing.

The files of a run are written to a temporary folder, synced, and moved into place by a single rename. Its ``manifest.json`` has the
sha256 of each file except for timings. A process claims a run by a lock on a file with the name of the key. The operating system
releases the lock when the process ends in any way, so that no claim outlives its owner.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.evaluation.warned import row_of
from factorgraph_loc.files import bounded
from factorgraph_loc.files.temporary import sweep
from factorgraph_loc.model.scoring import Alignment
from factorgraph_loc.text import Notice

Whole = Annotated[int, Field(strict=True, ge=-(2**63), lt=2**63)]  # integers that fit into a column of a table
Figure = bool | Whole | Annotated[float, Field(strict=True, allow_inf_nan=False)] | None
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")]  # name of a file in the folder of a run
MANIFEST, METRICS, TIMINGS, FAILURE = "manifest.json", "metrics.json", "timings.json", "failure.json"
TIMING = "timing."  # start of the names of computing times
State = Literal["ok", "failed", "missing", "damaged"]
_AGAIN = "; `fgloc experiment run` repeats the run"


class DamagedError(InputError):
    """A stored file is missing, or its content has changed since it was written."""


class StoredFile(BaseModel):
    """Base class of the content of JSON files in the store."""

    model_config = ConfigDict(frozen=True, strict=True)


class RunManifest(StoredFile):
    """The content of ``manifest.json``: the ``key`` of a run, and {file name: sha256} of its ``files``."""

    key: str
    files: dict[FileName, str]


class Failure(StoredFile):
    """The content of ``failure.json``. ``kind``: such as "timeout". ``reason``: a sentence about why the run failed."""

    kind: str
    reason: str


class Figures(StoredFile):
    """The content of ``metrics.json`` and ``timings.json``: scores or times of a run by name, and ``warnings``.

    A value is a number, None, a list of these, or the name of an alignment.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Figure | list[Figure] | Alignment] = Field(init=False)
    warnings: list[Notice] = []


Kind = TypeVar("Kind", bound=StoredFile)


def parse_stored(kind: type[Kind], content: bytes, path: Path) -> Kind:
    """Return the JSON ``content`` of the file ``path`` as an object of the class ``kind``. Raises DamagedError if it is
    invalid."""
    try:
        return kind.model_validate_json(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])[:60]
        raise DamagedError(f"{path}: is damaged ({where}{': ' * bool(where)}{first['msg'][:80]})") from error


class StoreError(RunFailedError):
    """The store cannot be written, because the disk is full or permissions are missing."""


class Store:
    """The store of results in the folder ``folder/store``. It has a folder for each run, named by the key of the run.

    Several processes may use it. Methods raise StoreError if the store cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "store"

    def create(self) -> None:
        """Create the folders of the store, and remove files of processes that died."""
        with self._writing():
            for name in ("claims", "tmp"):
                (self.folder / name).mkdir(parents=True, exist_ok=True)
        for folder in (self.folder.parent, self.folder):
            sweep(folder)
        self.sweep()

    def sweep(self) -> None:
        """Remove the locks and the partial results of processes that died."""
        with self._writing():
            keys = {path.name for name in ("claims", "tmp") for path in (self.folder / name).iterdir()}
        for key in keys:
            with self.claim(key) as mine:
                if mine:
                    _remove(self.folder / "tmp" / key)

    def path(self, key: str) -> Path:
        """Return the folder with the files of the run ``key``."""
        return self.folder / key[:2] / key

    def state(self, key: str) -> State:
        """Return the state of the results of the run ``key``: ok, failed, missing or damaged. It checks all files."""
        try:
            manifest = self._manifest(key)
            for name in manifest.files:
                self._read(manifest, name)
            self._row(manifest)  # reads the scores, or the failure
        except DamagedError:
            return "damaged" if os.path.lexists(self.path(key)) else "missing"
        return "failed" if FAILURE in manifest.files else "ok"

    def read(self, key: str, name: str) -> bytes:
        """Return the file ``name`` of the run ``key``. Raises DamagedError if it is missing or has a wrong checksum."""
        return self._read(self._manifest(key), name)

    def row(self, key: str) -> dict[str, Any]:
        """Return the columns of a run for the table of results, as {name: value}.

        They are ``status`` (ok, failed), ``kind`` and ``reason`` of a failure, and ``warnings`` (one per line). Scores
        and times that are single numbers are columns too. Raises DamagedError if a file is missing or has a wrong
        checksum.
        """
        return self._row(self._manifest(key))

    def _row(self, manifest: RunManifest) -> dict[str, Any]:
        folder = self.path(manifest.key)
        state: dict[str, Any] = {"status": "ok", "kind": None, "reason": None}
        scores: dict[str, Any] = {}
        if FAILURE in manifest.files:
            failure = parse_stored(Failure, self._read(manifest, FAILURE), folder / FAILURE)
            state = {"status": "failed", "kind": failure.kind, "reason": failure.reason}
        else:
            scores = dict(parse_stored(Figures, self._read(manifest, METRICS), folder / METRICS))
        with suppress(DamagedError):  # timings are optional
            times = parse_stored(Figures, self._read(manifest, TIMINGS), folder / TIMINGS)
            scores |= {name: value for name, value in times.model_dump().items() if name.startswith(TIMING)}
        return row_of(state | {name: value for name, value in scores.items() if name not in state})

    def _read(self, manifest: RunManifest, name: str) -> bytes:
        """Return the file ``name`` of a run. Raises DamagedError if its checksum differs from the manifest."""
        path = self.path(manifest.key) / name
        expected = manifest.files.get(name)
        content = self._content(path)
        if expected is None and name != TIMINGS:
            raise DamagedError(f"{path}: is not in {MANIFEST}{_AGAIN}")
        if expected is not None and expected != _sha256(content):
            raise DamagedError(f"{path}: is damaged (its sha256 differs){_AGAIN}")
        return content

    def _manifest(self, key: str) -> RunManifest:
        path = self.path(key) / MANIFEST
        manifest = parse_stored(RunManifest, self._content(path), path)
        if manifest.key != key:
            raise DamagedError(f"{path}: is the manifest of another run{_AGAIN}")
        return manifest

    def _content(self, path: Path) -> bytes:
        try:
            return bounded.read_bytes(path, bounded.DATA)
        except InputError as error:
            raise DamagedError(f"{error}{_AGAIN}") from error

    def put(self, key: str, files: Mapping[str, bytes]) -> None:
        """Write the files of a run atomically, and replace existing ones. The caller must lock the run (:meth:`claim`).
        ``files``: {file name: content}."""
        checksums = {name: _sha256(content) for name, content in files.items() if name != TIMINGS}
        manifest = json.dumps({"key": key, "files": checksums}, indent=1).encode()
        temporary = self.folder / "tmp" / key
        with self._writing():
            _remove(temporary)
            (temporary / "run").mkdir(parents=True)
            try:
                for name, content in (*files.items(), (MANIFEST, manifest)):
                    _write(temporary / "run" / name, content)
                _sync(temporary / "run")
                if self.path(key).parent.is_file():
                    self.path(key).parent.unlink(missing_ok=True)
                self.path(key).parent.mkdir(exist_ok=True)
                if os.path.lexists(self.path(key)):
                    self.path(key).rename(temporary / "old")
                (temporary / "run").rename(self.path(key))
                _sync(self.path(key).parent)
            finally:
                _remove(temporary)

    @contextmanager
    def claim(self, key: str) -> Iterator[bool]:
        """Lock the run ``key`` in this ``with`` block. Yields False if another process has already locked it, else
        True."""
        path = self.folder / "claims" / key
        with self._writing():
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            mine = _lock(handle, path)
            if mine:
                with self._writing():
                    os.truncate(handle, 0)
                    os.write(handle, f"{socket.gethostname()} {os.getpid()}\n".encode())
            try:
                yield mine
            finally:
                if mine:
                    path.unlink(missing_ok=True)
        finally:
            os.close(handle)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Convert an OSError in this block to a StoreError."""
        try:
            yield
        except OSError as error:
            raise StoreError(
                f"{error.filename or self.folder}: cannot be written: {error.strerror or error}"
            ) from error


def _remove(path: Path) -> None:
    """Remove a folder with its content, or a file. Errors are ignored."""
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink()


def _lock(handle: int, path: Path) -> bool:
    """Lock the open file ``handle`` without waiting. Return False if another process has locked or removed it."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    try:
        return os.fstat(handle).st_ino == path.stat().st_ino
    except FileNotFoundError:
        return False


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _write(path: Path, content: bytes) -> None:
    """Write a file, and wait until it is on the disk."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync(folder: Path) -> None:
    """Wait until the entries of a folder are on the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
