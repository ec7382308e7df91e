"""Planned runs in local processes: each worker makes many runs, so that short runs do not wait for imports.

A run that exceeds its limit of time or memory is ended with its process, and fails; the others continue.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import TYPE_CHECKING

from factorgraph_loc.experiments.execute import Executor, Files, Kind, Planned, Take, compute, failure
from factorgraph_loc.files.bounded import resident_memory
from factorgraph_loc.files.temporary import of_system, sweep
from factorgraph_loc.processes import ProcessDiedError, Worker, serve, start

if TYPE_CHECKING:
    from factorgraph_loc.experiments.experiment_file import Limits

CHECK_INTERVAL = 0.1  # s between checks of memory and time
ATTEMPTS = (
    2  # a process may be killed because of others' memory; after two deaths the run itself is considered the cause
)
SHARE = 0.9  # of the machine's memory, for all workers together
PRELOADED = ("cv2", "factorgraph_loc.experiments.output")  # modules that a worker imports before its first run


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
