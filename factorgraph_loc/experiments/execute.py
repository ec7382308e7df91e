"""Execution of planned runs. A run is claimed in the store, computed by an executor, and stored.

An executor computes runs in local processes or on a cluster (:mod:`~factorgraph_loc.experiments.cluster`). A claim excludes other
processes that use the same store, so that no run is computed twice. A local worker process computes many runs, so that short runs
do not wait for imports. A run that exceeds its limit of time or memory fails, and its process is killed. Other runs continue.
"""

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
RETRY_INTERVAL = 0.5  # s between attempts to claim a run that another process has claimed
CHECK_INTERVAL = 0.1  # s between checks of memory and time
ATTEMPTS = 2  # a run fails if its process dies this many times; a single death may be due to other processes
SHARE = 0.9  # fraction of the machine's memory that all workers together may use
PRELOADED = ("cv2", "factorgraph_loc.experiments.output")  # modules that a worker imports before its first run
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


class Planned(Protocol):
    """A planned run, which can be pickled and sent to other processes.

    ``key``: key of its results in the store. ``source``: identifies the data that it loads. Runs with the same source
    are computed in the same process if possible. ``shown``: a description that distinguishes the run from others.
    ``columns``: {name: value} of the first columns of its row in the table of results.
    """

    @property
    def key(self) -> str: ...
    @property
    def source(self) -> Hashable: ...
    @property
    def shown(self) -> str: ...
    @property
    def columns(self) -> dict[str, Any]: ...

    def make(self) -> Files:
        """Compute the run, and return {file name: content}. Raises FglocError if it fails for a known reason."""


class Take(Protocol):
    """A function that reserves and returns the next run to compute, or None if there is none now."""

    def __call__(self, loaded: Hashable = None, avoided: Sequence[Hashable] = ()) -> Planned | None:
        """Return the next run, or None if there is none now. Runs of the source ``loaded`` are preferred. ``loaded``:
        the source that the worker has in memory. ``avoided``: sources that other workers have in memory. Their runs are
        returned only if there are no others."""


class Executor(AbstractContextManager[Any], Protocol):
    """Computes runs by :func:`compute` in other processes. As a context manager, it stops all computations on exit."""

    def submit(self, take: Take, left: int) -> None:
        """Start as many runs as possible. ``take``: a function that returns the next run. ``left``: number of all
        unfinished runs."""

    def finished(self) -> Iterable[tuple[str, Files]]:
        """Return (key, files) of each run that has ended since the last call. Waits at most about half a second."""


class _Queue:
    """The runs to compute. ``later``: pairs (time of the next attempt [s], run), for runs that another process computes
    now."""

    def __init__(self, runs: Sequence[Planned]) -> None:
        self._runs: dict[Hashable, list[Planned]] = {}
        self.later: list[tuple[float, Planned]] = []
        for run in runs:
            self._add(run)

    def __len__(self) -> int:
        return sum(map(len, self._runs.values())) + len(self.later)

    def next(self, loaded: Hashable, avoided: Sequence[Hashable]) -> Planned | None:
        """Remove and return the next run, or return None if there is none now. ``loaded``: a preferred source of the
        run. ``avoided``: sources of runs that are returned only if there are no others."""
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
    """Compute ``runs`` and store their results or failures below ``folder``. Yield (key, state) of each run when it
    ends.

    ``executor``: computes the runs in other processes. Runs with stored results are not repeated. ``again``: repeat
    stored failures. If another process computes a run, this waits for its result. When the generator is closed, the
    executor stops immediately, and unfinished runs are not stored. Raises StoreError if the store cannot be written.
    """
    store, queue = Store(folder), _Queue(runs)
    claims: dict[str, ExitStack] = {}
    stored: list[tuple[str, State]] = []  # runs that other processes have stored

    def take(loaded: Hashable = None, avoided: Sequence[Hashable] = ()) -> Planned | None:
        while (run := queue.next(loaded, avoided)) is not None:
            with ExitStack() as claim:
                if not claim.enter_context(store.claim(run.key)):
                    queue.later.append((time.monotonic() + RETRY_INTERVAL, run))
                    continue
                state = store.state(run.key)  # another process may have stored it since the runs were planned
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
    """Compute a run in this process. Return {file name: content}. After a failure, the only file describes the failure.

    Raises only StoreError, if the disk for temporary files is full or not writable.
    """
    import cv2  # noqa: PLC0415

    cv2.setNumThreads(1)
    _forget_peak_memory()
    try:
        return run.make()
    except MemoryError:
        return failure("memory", "the run needed more memory than was available")
    except FglocError as error:
        return failure("vanished" if isinstance(error, VanishedError) else "error", str(error))
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _DISK:
            raise StoreError(f"{tempfile.gettempdir()}: cannot be written: {error.strerror}") from error
        details = "".join(traceback.format_exception(error))
        return failure("error", f"{type(error).__name__}: {error_text(error)}", details)


def failure(kind: Kind, reason: str, details: str = "") -> Files:
    """Return {file name: JSON} with the file that describes a failed run. ``kind``: such as "timeout". ``reason``: a
    sentence for the user. ``details``: a traceback, or ""."""
    content = {"kind": kind, "reason": reason} | ({"traceback": details} if details else {})
    return {FAILURE: json_text(content).encode()}


def _forget_peak_memory() -> None:
    """Reset the peak memory of this process that the kernel records (proc(5), clear_refs 5), if possible."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return


@dataclass(eq=False)
class _Worker(Worker):
    """A worker process. ``source``: source of the data of its last run, which are in memory. ``since`` [s]: start of
    this run."""

    source: Hashable = None
    since: float = 0.0


class Processes(Executor):
    """Computes runs in at most ``jobs`` local processes. ``limits``: memory and time of each run. Raises
    ProcessDiedError if no process can be started."""

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
            run, failed = worker.job, self._exceeded_limit(worker)
            if worker.connection in readable:
                was_ready, answer = worker.ready, worker.receive()
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
        """Return the kind and the reason of a failure if a ``worker`` died in a run. None if the run is repeated."""
        if not worker.ready:
            self._stillborn += 1
            if self._stillborn >= ATTEMPTS:
                raise ProcessDiedError("a worker process ended before it was ready")
        if worker.job is None:
            return None
        self._deaths[worker.job.key] += 1
        if self._deaths[worker.job.key] < ATTEMPTS:
            self._repeated.append(worker.job)
            return None
        return "killed", f"its process died {ATTEMPTS} times without a message (killed, or a crash in native code)"

    def _exceeded_limit(self, worker: _Worker) -> tuple[Kind, str] | None:
        """Return the kind and the reason of a failure if a run exceeds its time or memory limit, else None."""
        if worker.job is None:
            return None
        if time.monotonic() - worker.since > self._time:
            return "timeout", f"it took more than {self._time:g} s"
        if resident_memory(worker.process.pid) > self._memory:
            return "memory", f"its process used more than {self._memory / 1e6:.0f} MB of memory"
        return None


def _machine_memory() -> float:
    """Return the physical memory of this machine in bytes."""
    return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
