"""Planned runs in local processes: each worker makes many runs, so that short runs do not wait for imports.

A run that exceeds its limit of time or memory is ended with its process, and stored as failed; the others continue.
"""

import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path

from factorgraph_loc.experiments import worker
from factorgraph_loc.experiments.execute import Kind, Outcome, store_failure
from factorgraph_loc.experiments.experiment_file import Limits
from factorgraph_loc.experiments.log_source import LogSource
from factorgraph_loc.experiments.plan import PlannedRun
from factorgraph_loc.experiments.store import Store
from factorgraph_loc.files.bounded import resident_memory
from factorgraph_loc.files.temporary import of_system, sweep
from factorgraph_loc.processes import Child, ProcessDiedError, start

LOOK = 0.1  # s between checks of memory and time
AGAIN = 0.5  # s after which a run that another process had claimed is retried
ATTEMPTS = (
    2  # a process may be killed because of others' memory; after two deaths the run itself is considered the cause
)
SHARE = 0.9  # of the machine's memory, for all workers together


@dataclass
class _Worker:
    process: Child
    connection: Connection
    ready: bool = False
    run: PlannedRun | None = None
    source: LogSource | None = None  # of its last run, whose log is loaded
    since: float = 0.0


@dataclass
class _Queue:
    """The runs to be made; a worker preferably gets runs of the log it has loaded, else of one that no other has."""

    runs: dict[LogSource, list[PlannedRun]] = field(default_factory=dict)
    later: list[tuple[float, PlannedRun]] = field(default_factory=list)

    def __len__(self) -> int:
        return sum(map(len, self.runs.values())) + len(self.later)

    def add(self, run: PlannedRun) -> None:
        self.runs.setdefault(run.source, []).append(run)

    def next(self, own: LogSource | None, taken: Sequence[LogSource]) -> PlannedRun | None:
        """The next run for a worker whose log is ``own``, while others have those in ``taken``."""
        while self.later and self.later[0][0] <= time.monotonic():
            self.add(self.later.pop(0)[1])
        if not self.runs:
            return None
        free = [source for source in self.runs if source not in taken]
        most = max(self.runs, key=lambda source: len(self.runs[source]))
        chosen = own if own in self.runs else free[0] if free else most
        assert chosen is not None
        run = self.runs[chosen].pop(0)
        if not self.runs[chosen]:
            del self.runs[chosen]
        return run


def execute(
    runs: Sequence[PlannedRun], folder: Path, *, jobs: int, limits: Limits, again: bool = False
) -> Iterator[Outcome]:
    """Make ``runs`` in ``jobs`` processes, store them below ``folder``, and yield their outcomes.

    ``again``: retry stored failures. When the generator is closed, the processes end at once, and unfinished runs are not stored.
    Raises StoreError if the store cannot be written, ProcessDiedError if no process can be started.
    """
    pool = _Pool(folder, limits, again, min(jobs, len(runs)))
    for run in runs:
        pool.queue.add(run)
    try:
        yield from pool.outcomes()
    finally:
        pool.close()


class _Pool:
    def __init__(self, folder: Path, limits: Limits, again: bool, jobs: int) -> None:
        self.queue = _Queue()
        self._folder, self._again = folder, again
        self._time = limits.time
        self._memory = limits.memory * 1e6 if limits.memory is not None else SHARE * _machine_memory() / max(jobs, 1)
        self._deaths: Counter[str] = Counter()
        self._stillborn = 0
        self._jobs = jobs
        self._workers: list[_Worker] = []

    def outcomes(self) -> Iterator[Outcome]:
        while left := len(self.queue) + sum(w.run is not None for w in self._workers):
            while len(self._workers) < min(self._jobs, left):
                self._workers.append(self._start())
            for w in self._workers:
                if w.ready and w.run is None:
                    self._assign(w)
            heard = wait([w.connection for w in self._workers], LOOK)
            for w in list(self._workers):
                failure = self._too_much(w)
                if w.connection in heard:
                    try:
                        message = w.connection.recv()
                    except (EOFError, OSError):
                        self._end(w)
                        failure = self._died(w)
                    else:
                        yield from self._heard(w, message)
                        continue
                elif failure is not None:
                    self._end(w)
                if w.run is not None and failure is not None:
                    yield from self._settle(w.run, store_failure(w.run, self._folder, *failure))

    def _end(self, w: _Worker) -> None:
        w.process.kill()
        w.process.join()
        w.connection.close()
        self._workers.remove(w)

    def close(self) -> None:
        for w in self._workers:
            w.process.kill()
        for w in self._workers:
            w.process.join()
        Store(self._folder).sweep()
        sweep(of_system("run").parent)

    def _start(self) -> _Worker:
        return _Worker(*start(worker.serve, self._folder, self._again))

    def _assign(self, w: _Worker) -> None:
        others = [o.source for o in self._workers if o is not w and o.run is not None and o.source is not None]
        run = self.queue.next(w.source, others)
        if run is not None:
            w.run, w.source, w.since = run, run.source, time.monotonic()
            with suppress(OSError):  # it has died, which the next check detects
                w.connection.send(run)

    def _heard(self, w: _Worker, message: object) -> Iterator[Outcome]:
        if message == worker.READY:
            w.ready, self._stillborn = True, 0
            return
        if isinstance(message, Exception):
            raise message
        assert isinstance(message, Outcome)
        assert w.run is not None
        run, w.run = w.run, None
        yield from self._settle(run, message)

    def _settle(self, run: PlannedRun, outcome: Outcome) -> Iterator[Outcome]:
        if outcome.status == "busy":
            self.queue.later.append((time.monotonic() + AGAIN, run))
        else:
            yield outcome

    def _died(self, w: _Worker) -> tuple[Kind, str] | None:
        """The failure that the death of a worker means for its run; None if it is retried."""
        if not w.ready:
            self._stillborn += 1
            if self._stillborn >= ATTEMPTS:
                raise ProcessDiedError("a worker process ended before it began")
        if w.run is None:
            return None
        self._deaths[w.run.key] += 1
        if self._deaths[w.run.key] < ATTEMPTS:
            self.queue.add(w.run)
            return None
        return "killed", f"its process died without a word, {ATTEMPTS} times (killed, or a crash in native code)"

    def _too_much(self, w: _Worker) -> tuple[Kind, str] | None:
        if w.run is None:
            return None
        if time.monotonic() - w.since > self._time:
            return "timeout", f"it took more than {self._time:g} s"
        if resident_memory(w.process.pid) > self._memory:
            return "memory", f"its process held more than {self._memory / 1e6:.0f} MB"
        return None


def _machine_memory() -> float:
    return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
