"""Execution of planned runs: each is claimed in the store, computed by an executor, and stored here under its claim.

An executor computes in local processes or on a cluster (:mod:`~factorgraph_loc.experiments.cluster`). Only this process stores, so
that nothing is stored twice, even if other processes use the same store. A local process makes many runs, so that short runs do
not wait for imports. A run that exceeds its limit of time or memory is ended with its process, and fails; the others continue."""

from __future__ import annotations

import errno
import os
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Literal, Protocol

from factorgraph_loc.errors import FglocError
from factorgraph_loc.experiments.experiment_file import Limits
from factorgraph_loc.experiments.keys import VanishedError
from factorgraph_loc.experiments.store import FAILURE, State, Store, StoreError
from factorgraph_loc.files.bounded import resident_memory
from factorgraph_loc.files.temporary import of_system, sweep
from factorgraph_loc.processes import ProcessDiedError, Worker, serve, start
from factorgraph_loc.text import error_text, json_text

Files = dict[str, bytes]
Kind = Literal["error", "timeout", "memory", "killed", "vanished", "refused"]
RETRY_INTERVAL = 0.5  # s after which a run that another process has claimed is tried again
CHECK_INTERVAL = 0.1  # s between checks of memory and time
ATTEMPTS = (
    2  # a process may be killed because of others' memory; after two deaths the run itself is considered the cause
)
SHARE = 0.9  # of the machine's memory, for all workers together
PRELOADED = ("cv2", "factorgraph_loc.experiments.output")  # modules that a worker imports before its first run
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


class Planned(Protocol):
    """A run as plain data that can be sent to other processes. ``key``: of its results; ``source``: of the data that it loads,
    which the next run in the same process may share. ``shown``: a description that distinguishes it from the other runs;
    ``columns``: the first columns of its row in the table of results."""

    @property
    def key(self) -> str: ...
    @property
    def source(self) -> Hashable: ...
    @property
    def shown(self) -> str: ...
    @property
    def columns(self) -> dict[str, Any]: ...

    def make(self) -> Files:
        """The files of the run. Raises FglocError if it fails for a known reason."""


class Take(Protocol):
    """A function that returns the next claimed run, or None if there is none now."""

    def __call__(self, loaded: Hashable = None, avoided: Sequence[Hashable] = ()) -> Planned | None:
        """The run has the source ``loaded`` if possible, else one that is not among ``avoided``."""


class Executor(AbstractContextManager[Any], Protocol):
    """Computes runs with :func:`compute`, in other processes. The end of the context ends all computations."""

    def submit(self, take: Take, left: int) -> None:
        """Begin as many runs as there is room for; ``left``: the number of runs that are not stored yet."""

    def finished(self) -> Iterable[tuple[str, Files]]:
        """The keys of runs that have ended, with their files; returns within about half a second."""


class _Queue:
    """The runs that are to be made, by source, and the ``later`` ones, which another process has claimed."""

    def __init__(self, runs: Sequence[Planned]) -> None:
        self._runs: dict[Hashable, list[Planned]] = {}
        self.later: list[tuple[float, Planned]] = []
        for run in runs:
            self._add(run)

    def __len__(self) -> int:
        return sum(map(len, self._runs.values())) + len(self.later)

    def next(self, loaded: Hashable, avoided: Sequence[Hashable]) -> Planned | None:
        """The next run; see :class:`Take`."""
        while self.later and self.later[0][0] <= time.monotonic():
            self._add(self.later.pop(0)[1])
        if not self._runs:
            return None
        most = max(self._runs, key=lambda source: len(self._runs[source]))
        free = next((source for source in self._runs if source not in avoided), most)
        chosen = loaded if loaded in self._runs else free
        run = self._runs[chosen].pop(0)
        if not self._runs[chosen]:
            del self._runs[chosen]
        return run

    def _add(self, run: Planned) -> None:
        self._runs.setdefault(run.source, []).append(run)


def execute(
    runs: Sequence[Planned], folder: Path, executor: Executor, *, again: bool = False
) -> Iterator[tuple[str, State]]:
    """Make ``runs``, store their results or failures in the store below ``folder`` unless they exist, and yield the key and the
    state of each.

    ``again``: repeat stored failures. A run that another process has claimed is waited for. When the generator is closed, the
    executor ends without delay, and unfinished runs are not stored. Raises StoreError if the store cannot be written.
    """
    store, queue = Store(folder), _Queue(runs)
    claims: dict[str, ExitStack] = {}
    stored: list[tuple[str, State]] = []  # by other processes

    def take(loaded: Hashable = None, avoided: Sequence[Hashable] = ()) -> Planned | None:
        while (run := queue.next(loaded, avoided)) is not None:
            with ExitStack() as claim:
                if not claim.enter_context(store.claim(run.key)):
                    queue.later.append((time.monotonic() + RETRY_INTERVAL, run))
                    continue
                state = store.state(run.key)  # the caller considers it missing or damaged
                if state not in ("ok", "failed") or (state == "failed" and again):
                    claims[run.key] = claim.pop_all()
                    return run
            stored.append((run.key, state))
        return None

    try:
        with executor:
            while left := len(queue) + len(claims):
                executor.submit(take, left)
                yield from stored
                stored.clear()
                for key, files in executor.finished():
                    with claims.pop(key):
                        store.put(key, files)
                    yield key, store.state(key)
    finally:
        for claim in claims.values():
            claim.close()
        store.sweep()


def compute(run: Planned) -> Files:
    """The files of a run, or of its failure, for :meth:`~factorgraph_loc.experiments.store.Store.put`.

    Raises StoreError only, if there is no space for them.
    """
    import cv2  # noqa: PLC0415

    cv2.setNumThreads(1)
    _forget_peak_memory()
    try:
        return run.make()
    except MemoryError:
        return failure("memory", "there was no memory left")
    except FglocError as error:
        return failure("vanished" if isinstance(error, VanishedError) else "error", str(error))
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _DISK:
            raise StoreError(f"{tempfile.gettempdir()}: cannot be written: {error.strerror}") from error
        details = "".join(traceback.format_exception(error))
        return failure("error", f"{type(error).__name__}: {error_text(error)}", details)


def failure(kind: Kind, reason: str, details: str = "") -> Files:
    """The files of a failed run; ``details``: a traceback."""
    content = {"kind": kind, "reason": reason} | ({"traceback": details} if details else {})
    return {FAILURE: json_text(content).encode()}


def _forget_peak_memory() -> None:
    """Reset the kernel's peak memory of this process (proc(5), clear_refs 5), where possible."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return


@dataclass(eq=False)
class _Worker(Worker):
    source: Hashable = None  # of its last run, whose data are loaded
    since: float = 0.0


class Processes(Executor):
    """Computes runs in at most ``jobs`` processes. Raises ProcessDiedError if none can be started."""

    def __init__(self, jobs: int, limits: Limits) -> None:
        self._jobs, self._time = jobs, limits.time
        self._memory = limits.memory * 1e6 if limits.memory is not None else SHARE * _machine_memory() / jobs
        self._deaths: Counter[str] = Counter()
        self._stillborn = 0
        self._repeated: list[Planned] = []
        self._team: list[_Worker] = []

    def __exit__(self, *_: object) -> None:
        for worker in self._team:
            worker.end()
        sweep(of_system("run").parent)

    def submit(self, take: Take, left: int) -> None:
        while len(self._team) < min(self._jobs, left):
            self._team.append(_Worker(*start(serve, *PRELOADED)))
            self._team[-1].send(compute)
        for worker in self._team:
            if worker.ready and worker.job is None:
                busy = [o.source for o in self._team if o.job is not None and o.source is not None]
                run = self._repeated.pop() if self._repeated else take(worker.source, busy)
                if run is None:
                    return
                worker.job, worker.source, worker.since = run, run.source, time.monotonic()
                worker.send(run)

    def finished(self) -> Iterator[tuple[str, Files]]:
        readable = wait([worker.connection for worker in self._team], CHECK_INTERVAL)
        for worker in list(self._team):
            run, failed = worker.job, self._too_much(worker)
            if worker.connection in readable:
                was_ready, answer = worker.ready, worker.hear()
                if not isinstance(answer, ProcessDiedError):
                    worker.job = None
                    if isinstance(answer, Exception):
                        raise answer
                    if was_ready:
                        yield run.key, answer
                    else:
                        self._stillborn = 0
                    continue
                failed = self._died(worker)
            elif failed is None:
                continue
            worker.end()
            self._team.remove(worker)
            if failed is not None:
                yield run.key, failure(*failed)

    def _died(self, worker: _Worker) -> tuple[Kind, str] | None:
        """The failure that the death of a worker means for its run; None if it is repeated."""
        if not worker.ready:
            self._stillborn += 1
            if self._stillborn >= ATTEMPTS:
                raise ProcessDiedError("a worker process ended before it began")
        if worker.job is None:
            return None
        self._deaths[worker.job.key] += 1
        if self._deaths[worker.job.key] < ATTEMPTS:
            self._repeated.append(worker.job)
            return None
        return "killed", f"its process died without a word, {ATTEMPTS} times (killed, or a crash in native code)"

    def _too_much(self, worker: _Worker) -> tuple[Kind, str] | None:
        if worker.job is None:
            return None
        if time.monotonic() - worker.since > self._time:
            return "timeout", f"it took more than {self._time:g} s"
        if resident_memory(worker.process.pid) > self._memory:
            return "memory", f"its process held more than {self._memory / 1e6:.0f} MB"
        return None


def _machine_memory() -> float:
    return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
