"""One planned run: computed, or stored under its key, by whichever process it is sent to."""

from __future__ import annotations

import errno
import json
import tempfile
import traceback
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

from factorgraph_loc.errors import FglocError, InputError
from factorgraph_loc.experiments.plan import PlannedRun
from factorgraph_loc.experiments.store import FAILURE, Store, StoreError
from factorgraph_loc.text import told

if TYPE_CHECKING:
    from factorgraph_loc.experiments.log_source import LogSource
    from factorgraph_loc.model.log import Log

Kind = Literal["error", "timeout", "memory", "killed", "vanished"]
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass(frozen=True)
class Outcome:
    """What became of a run: its results are stored (``ok``), its failure is, or another process is at it (``busy``)."""

    key: str
    status: Literal["ok", "failed", "busy"]
    reason: str | None = None


class VanishedError(InputError):
    """A log is not there any more, or is another one than was planned."""


def run_planned(run: PlannedRun, folder: Path, *, again: bool = False) -> Outcome:
    """Make a run and store its results, or its failure, in the store below ``folder``, unless they are there.

    ``again``: a stored failure is tried again. StoreError if the store cannot be written; nothing else is raised.
    """
    store = Store(folder)
    with store.claim(run.key) as mine:
        if not mine:
            return Outcome(run.key, "busy")
        state = store.state(run.key, thorough=True)  # that of a run which its caller takes to be missing or damaged
        if state == "ok" or (state == "failed" and not again):
            return stored_outcome(run.key, store)
        store.put(run.key, compute(run))
        return stored_outcome(run.key, store)


def store_failure(run: PlannedRun, folder: Path, kind: Kind, reason: str) -> Outcome:
    """Store what became of a run whose process could not do so itself."""
    store = Store(folder)
    with store.claim(run.key) as mine:
        if not mine:
            return Outcome(run.key, "busy")
        if store.state(run.key, thorough=True) != "ok":
            store.put(run.key, {FAILURE: failure_file(kind, reason)})
        return stored_outcome(run.key, store)


def compute(run: PlannedRun) -> dict[str, bytes]:
    """The files of a run, or of its failure, for :meth:`~factorgraph_loc.experiments.store.Store.put`.

    StoreError if there is no room for them; nothing else is raised.
    """
    from factorgraph_loc.experiments.run import run as run_log  # noqa: PLC0415
    from factorgraph_loc.experiments.stored_run import run_files  # noqa: PLC0415

    _forget_peak_memory()
    started = perf_counter()
    try:
        log = _load(run.source, run.log_digest)
        files = run_files(run_log(log, run.config), log, started)
    except MemoryError:
        files = {FAILURE: failure_file("memory", "there was no memory left")}
    except FglocError as error:
        kind: Kind = "vanished" if isinstance(error, VanishedError) else "error"
        files = {FAILURE: failure_file(kind, str(error))}
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _DISK:
            raise StoreError(f"{tempfile.gettempdir()}: cannot be written: {error.strerror}") from error
        reason = f"{type(error).__name__}: {told(error)}"
        files = {FAILURE: failure_file("error", reason, "".join(traceback.format_exception(error)))}
    return files


def failure_file(kind: Kind, reason: str, details: str = "") -> bytes:
    """The content of ``failure.json``."""
    content: dict[str, Any] = {"kind": kind, "reason": reason}
    return (json.dumps(content | ({"traceback": details} if details else {}), indent=2) + "\n").encode()


@lru_cache(maxsize=4)
def _load(source: LogSource, digest: str) -> Log:
    """The log of a source; it is kept, as the runs of one log follow each other."""
    from factorgraph_loc.experiments.keys import source_digest  # noqa: PLC0415

    try:
        now = source_digest(source)
    except InputError as error:
        raise VanishedError(f"the log has vanished: {error}") from error
    if now != digest:
        raise VanishedError("the log is another one than when the experiment began")
    return source.load()


def stored_outcome(key: str, store: Store) -> Outcome:
    """What became of a run whose results, or whose failure, are stored."""
    state = store.state(key)
    if state == "failed":
        return Outcome(key, "failed", str(store.row(key)["reason"]))
    return Outcome(key, "ok")


def _forget_peak_memory() -> None:
    """Let the kernel count the peak of this process anew (proc(5), clear_refs 5), where it can."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return
