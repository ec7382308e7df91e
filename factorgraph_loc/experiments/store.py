"""Results of runs on disk, a folder each by its key, whole or not there at all.

A run's files are written beside the store's folders, synced, and moved into place by one rename. Its ``manifest.json`` holds the
sha256 of each file but those of timings. Who computes a run holds a lock on a file named by its key; the system lets go of it
when its process ends, however it ends, so that no claim outlives its owner.
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
from typing import TYPE_CHECKING, Any, Literal

from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.evaluation.warned import row_of

if TYPE_CHECKING:
    from factorgraph_loc.evaluation.figures import Track

MANIFEST, METRICS, TIMINGS, FAILURE = "manifest.json", "metrics.json", "timings.json", "failure.json"
State = Literal["ok", "failed", "missing", "damaged"]


class StoreError(RunFailedError):
    """The store cannot be read or written: the disk is full, or the folder may not be changed."""


class Store:
    """The results below ``folder``/store. StoreError where it cannot be written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "store"

    def create(self) -> None:
        """Make the folders, and remove what processes that died have left behind."""
        with self._writing():
            for name in ("claims", "tmp"):
                (self.folder / name).mkdir(parents=True, exist_ok=True)
        self.sweep()

    def sweep(self) -> None:
        """Remove what processes that died have left behind: claims, and results that are half-written."""
        for key in {path.name for name in ("claims", "tmp") for path in (self.folder / name).iterdir()}:
            with self.claim(key) as mine:
                if mine:
                    shutil.rmtree(self.folder / "tmp" / key, ignore_errors=True)

    def path(self, key: str) -> Path:
        """The folder of a run."""
        return self.folder / key[:2] / key

    def state(self, key: str, *, thorough: bool = False) -> State:
        """Whether results are there, and whole. Trajectories of the right size that are older than their manifest are taken as
        they are; other files, and all if ``thorough``, are read and compared with their checksums."""
        folder = self.path(key)
        try:
            manifest = json.loads((folder / MANIFEST).read_bytes())
            written = (folder / MANIFEST).stat().st_mtime_ns
            for name, said in manifest["files"].items():
                stat = (folder / name).stat()
                if stat.st_size != said["bytes"]:
                    return "damaged"
                doubtful = thorough or name in (METRICS, FAILURE) or stat.st_mtime_ns > written
                if doubtful and _sha256((folder / name).read_bytes()) != said["sha256"]:
                    return "damaged"
            if manifest["key"] != key:
                return "damaged"
        except FileNotFoundError:
            return "damaged" if folder.exists() else "missing"
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return "damaged"
        return "failed" if FAILURE in manifest["files"] else "ok"

    def read(self, key: str, name: str) -> bytes:
        """A file of a run, compared with its checksum; InputError if it is missing or damaged."""
        path = self.path(key) / name
        try:
            content = path.read_bytes()
            said = json.loads((self.path(key) / MANIFEST).read_bytes())["files"].get(name)
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"{path}: cannot be read, run the experiment again") from error
        if said is not None and said["sha256"] != _sha256(content):
            raise InputError(f"{path}: is damaged (its sha256 differs), run the experiment again")
        return content

    def row(self, key: str) -> dict[str, Any]:
        """``status`` (ok, failed), ``kind`` and ``reason`` of a failure, the scalar scores of a run, timings among them, and its
        ``warnings``, a line each."""
        if (self.path(key) / FAILURE).exists():
            failure = json.loads(self.read(key, FAILURE))
            row = {"status": "failed", "kind": failure["kind"], "reason": failure["reason"]}
        else:
            row = {"status": "ok", "kind": None, "reason": None} | json.loads(self.read(key, METRICS))
        with suppress(InputError, ValueError):  # times are not worth a run
            row |= json.loads(self.read(key, TIMINGS))
        return row_of(row)

    def track(self, key: str) -> Track:
        """The causal and the final trajectory of a run, with covariances, times [s] from its first estimate."""
        from factorgraph_loc.experiments.stored_run import read_track  # noqa: PLC0415

        return read_track(self.read(key, "estimates.parquet"))

    def put(self, key: str, files: Mapping[str, bytes]) -> None:
        """Write the files of a run, at once or not at all, in place of those that are there; its claim must be held."""
        said = {
            name: {"bytes": len(content), "sha256": _sha256(content)}
            for name, content in files.items()
            if name != TIMINGS
        }
        manifest = json.dumps({"key": key, "files": said}, indent=1).encode()
        temporary = self.folder / "tmp" / key
        with self._writing():
            shutil.rmtree(temporary, ignore_errors=True)
            (temporary / "run").mkdir(parents=True)
            try:
                for name, content in (*files.items(), (MANIFEST, manifest)):  # last, so that none is younger
                    _write(temporary / "run" / name, content)
                _sync(temporary / "run")
                self.path(key).parent.mkdir(exist_ok=True)
                if self.path(key).exists():
                    self.path(key).rename(temporary / "old")
                (temporary / "run").rename(self.path(key))
                _sync(self.path(key).parent)
            finally:
                shutil.rmtree(temporary, ignore_errors=True)

    @contextmanager
    def claim(self, key: str) -> Iterator[bool]:
        """Whether the run is ours while the block lasts; it is not if another process that lives has claimed it."""
        path = self.folder / "claims" / key
        with self._writing():
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            mine = _lock(handle, path)
            if mine:
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
        try:
            yield
        except OSError as error:
            raise StoreError(f"{self.folder}: cannot be written: {error.strerror or error}") from error


def _lock(handle: int, path: Path) -> bool:
    """Lock a file; False if another has it, or has just removed it."""
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
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
