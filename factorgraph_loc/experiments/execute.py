"""Execution of one planned run, or its lookup in the store, in any process."""

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
    """The outcome of a run: its results are stored (``ok``), its failure is, or another process works on it (``busy``)."""

    key: str
    status: Literal["ok", "failed", "busy"]
    reason: str | None = None


class VanishedError(InputError):
    """A log disappeared, or differs from the planned one."""


def run_planned(run: PlannedRun, folder: Path, *, again: bool = False) -> Outcome:
    """Make a run and store its results, or its failure, in the store below ``folder``, unless they exist.

    ``again``: retry a stored failure. Raises StoreError only, if the store cannot be written.
    """
    store = Store(folder)
    with store.claim(run.key) as mine:
        if not mine:
            return Outcome(run.key, "busy")
        state = store.state(run.key, thorough=True)  # the caller considers it missing or damaged
        if state == "ok" or (state == "failed" and not again):
            return stored_outcome(run.key, store)
        store.put(run.key, compute(run))
        return stored_outcome(run.key, store)


def store_failure(run: PlannedRun, folder: Path, kind: Kind, reason: str) -> Outcome:
    """Store the failure of a run whose process could not do so itself."""
    store = Store(folder)
    with store.claim(run.key) as mine:
        if not mine:
            return Outcome(run.key, "busy")
        if store.state(run.key, thorough=True) != "ok":
            store.put(run.key, {FAILURE: failure_file(kind, reason)})
        return stored_outcome(run.key, store)


def compute(run: PlannedRun) -> dict[str, bytes]:
    """The files of a run, or of its failure, for :meth:`~factorgraph_loc.experiments.store.Store.put`.

    Raises StoreError only, if there is no space for them.
    """
    from factorgraph_loc.experiments.output import run_files  # noqa: PLC0415
    from factorgraph_loc.experiments.run import run as run_log  # noqa: PLC0415

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
    content: dict[str, Any] = {"kind": kind, "reason": reason}
    return (json.dumps(content | ({"traceback": details} if details else {}), indent=2) + "\n").encode()


@lru_cache(maxsize=4)
def _load(source: LogSource, digest: str) -> Log:
    """The log of a source; cached, as consecutive runs use the same log."""
    from factorgraph_loc.experiments.keys import source_digest  # noqa: PLC0415

    try:
        now = source_digest(source)
    except InputError as error:
        raise VanishedError(f"the log has vanished: {error}") from error
    if now != digest:
        raise VanishedError("the log has changed since the experiment was planned")
    return source.load()


def stored_outcome(key: str, store: Store) -> Outcome:
    """The outcome of a run whose results, or whose failure, are stored."""
    state = store.state(key)
    if state == "failed":
        return Outcome(key, "failed", str(store.row(key)["reason"]))
    return Outcome(key, "ok")


def _forget_peak_memory() -> None:
    """Reset the kernel's peak memory of this process (proc(5), clear_refs 5), where possible."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return
