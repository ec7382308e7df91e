"""Execution of the runs of an experiment on an existing cluster of ``dask.distributed``.

Workers return the files of their runs, so a common file system is needed only for recorded logs. If a worker ends
during a run, another worker repeats the run.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from factorgraph_loc.errors import FglocError, InputError, RunFailedError
from factorgraph_loc.experiments.execute import Executor, Files, Planned, Take, compute, failure
from factorgraph_loc.experiments.keys import software_digest
from factorgraph_loc.experiments.log_source import RecordedSource
from factorgraph_loc.experiments.plan import PlannedRun
from factorgraph_loc.files.data_root import DATA_ROOT
from factorgraph_loc.text import error_text, quoted

if TYPE_CHECKING:
    from types import ModuleType

    from factorgraph_loc.experiments.experiment_file import Limits

CONNECT = 10.0  # s; maximum time to wait for the scheduler
POLL_INTERVAL = 0.5  # s; maximum time to wait for finished runs
QUEUED = 2  # number of runs that are sent to each worker, so that it always has a next run
RESTART = 60.0  # s; maximum time for the restart of a worker
_ONE = Lock()  # a worker process executes one run at a time, so that computing times are meaningful


@dataclass(frozen=True)
class _Made:
    """The result of a run. ``files``: {file name: content}. ``late``: address of a worker that still computes the run
    after the time limit, otherwise None."""

    files: Files
    late: str | None = None


class Cluster(Executor):
    """Executes runs on a ``dask.distributed`` cluster. ``scheduler``: address of its scheduler.

    This class limits the time of a run, and the cluster limits the memory. Entering the context (``with``) raises
    InputError if the package ``distributed`` is not installed, or if the scheduler does not answer or has no workers.
    InputError is also raised for a worker with other code or libraries, and RunFailedError if the connection is lost.
    """

    def __init__(self, scheduler: str, limits: Limits) -> None:
        self._scheduler, self._seconds = scheduler, limits.time
        self._session = uuid4().hex  # makes keys unique, because a scheduler returns the stored result of a known key
        self._sent: dict[Any, Planned] = {}

    def __enter__(self) -> Cluster:
        self._distributed = _import()
        named = f"--scheduler is {quoted(self._scheduler)}"
        try:
            self._client = self._distributed.Client(self._scheduler, timeout=CONNECT, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(f"{named}: no scheduler answers there: {error_text(error)}") from error
        if not self._client.nthreads():
            self._client.close()
            raise InputError(f"{named}: the scheduler has no workers; start one with `dask worker ADDRESS`")
        return self

    def __exit__(self, _: object, error: BaseException | None, *__: object) -> None:
        with suppress(Exception):  # the scheduler may be gone
            self._client.cancel(list(self._sent), force=True)
        self._client.close()
        if isinstance(error, OSError | self._distributed.CancelledError):  # of the connection
            raise RunFailedError(
                "the connection to the scheduler is lost; finished runs are stored, and the same command resumes"
            ) from error

    def submit(self, take: Take, left: int) -> None:
        room = QUEUED * max(1, sum(self._client.nthreads().values()))
        while len(self._sent) < min(room, left) and (run := take()) is not None:
            key = f"fgloc-{run.key}-{self._session}"
            future = self._client.submit(make, _findable(run), software_digest(), self._seconds, key=key, pure=False)
            self._sent[future] = run

    def finished(self) -> Iterator[tuple[str, Files]]:
        for future in self._done():
            run, made = self._sent.pop(future), self._result(future)
            yield run.key, made.files
            if made.late is not None:
                with suppress(Exception):  # a worker that Dask started without a nanny process cannot restart
                    self._client.restart_workers([made.late], timeout=RESTART, raise_for_error=False)

    def _done(self) -> list[Any]:
        """Wait for at most :data:`POLL_INTERVAL`, and return the futures of finished runs."""
        if not self._sent:
            time.sleep(POLL_INTERVAL)
            return []
        try:
            with self._client.as_current():
                done = self._distributed.wait(
                    list(self._sent), timeout=POLL_INTERVAL, return_when="FIRST_COMPLETED"
                ).done
                return list(done)
        except TimeoutError:
            return []

    def _result(self, future: Any) -> _Made:
        """Return the result of a finished run. Raises FglocError if a worker could not execute it."""
        if future.status != "error":
            made = future.result()
            assert isinstance(made, _Made)
            return made
        error = future.exception()
        if isinstance(error, self._distributed.KilledWorker):
            return _Made(failure("killed", "every worker that executed the run died"))
        if isinstance(error, FglocError):
            raise error
        raise RunFailedError(
            f"a worker could not execute a run: {type(error).__name__}: {error_text(error)}"
        ) from error


def make(run: Planned, version: str, seconds: float) -> _Made:
    """Execute a run on a worker, in at most ``seconds``. Return the files of the run, or of its failure.

    ``version``: digest of the code and libraries of the experiment. Raises InputError if the worker has another digest.
    """
    from distributed import get_worker  # noqa: PLC0415

    address = str(get_worker().address)
    if version != software_digest():
        raise InputError(
            f"{address}: this worker has another version of the code, or of a library, than the experiment"
        )
    made: SimpleQueue[Files | FglocError] = SimpleQueue()

    def work() -> None:
        try:
            made.put(compute(run))
        except FglocError as error:
            made.put(error)

    with _ONE:
        Thread(target=work, daemon=True).start()
        try:
            files = made.get(timeout=seconds)
        except Empty:
            return _Made(failure("timeout", f"it took more than {seconds:g} s"), late=address)
    if isinstance(files, FglocError):
        raise files
    return _Made(files)


def _findable(run: Planned) -> Planned:
    """Return the run with an absolute data folder, so that it does not depend on the environment of a worker."""
    if not isinstance(run, PlannedRun) or not isinstance(run.source, RecordedSource):
        return run
    root = run.source.data_root or os.environ.get(DATA_ROOT)
    return replace(run, source=replace(run.source, data_root=str(Path(root).resolve()) if root else None))


def _import() -> ModuleType:
    """Import the package ``distributed``. Raises InputError if it is not installed."""
    try:
        import distributed  # noqa: PLC0415
    except ImportError as error:
        raise InputError(
            "--scheduler needs the package distributed, which is not installed: pip install 'factorgraph-loc[cluster]'"
        ) from error
    return distributed
