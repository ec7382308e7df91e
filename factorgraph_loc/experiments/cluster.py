"""Planned runs on an existing cluster of ``dask.distributed``: workers compute, and only this process stores.

A run is claimed in the store while it is on the cluster; its files are sent back, and stored under that claim. Workers thus need
no common file system except for recorded logs, a run lost with its worker is repeated by another, and nothing is stored twice,
whatever other processes use the same store.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from factorgraph_loc.errors import FglocError, InputError, RunFailedError
from factorgraph_loc.experiments.execute import Kind, Outcome, compute, failure_file, stored_outcome
from factorgraph_loc.experiments.experiment_file import Limits
from factorgraph_loc.experiments.keys import code_version, digest_of, library_versions
from factorgraph_loc.experiments.log_source import LogSource, SimulatedSource
from factorgraph_loc.experiments.plan import PlannedRun
from factorgraph_loc.experiments.store import FAILURE, Store
from factorgraph_loc.text import quoted, told

if TYPE_CHECKING:
    from types import ModuleType

    from factorgraph_loc.experiments.experiment import Executor, Prepared

CONNECT = 10.0  # s to wait for the scheduler
LOOK = 0.5  # s between checks for finished runs, and for runs claimed by other processes
AHEAD = 2  # runs per busy worker, so that the next one does not wait for this process
RESTART = 60.0  # s for a worker to restart
_ONE = Lock()  # one run at a time in a process, for meaningful times


@dataclass(frozen=True)
class _Made:
    """The files of a run; ``late``: the address of the worker that is still busy with it after the time limit."""

    files: dict[str, bytes]
    late: str | None = None


@dataclass(frozen=True)
class _Sent:
    """A run on the cluster; ``claim``: to be closed once it is stored."""

    run: PlannedRun
    claim: ExitStack


def on_cluster(scheduler: str, prepared: Prepared, *, again: bool = False) -> Executor:
    """Return an executor of an experiment's runs on the cluster of ``scheduler``; see :func:`execute`."""
    limits = prepared.experiment.limits
    return partial(execute, folder=prepared.folder, scheduler=scheduler, limits=limits, again=again)


def execute(
    runs: Sequence[PlannedRun], folder: Path, *, scheduler: str, limits: Limits, again: bool = False
) -> Iterator[Outcome]:
    """Make ``runs`` on the cluster of the ``scheduler`` (its address), store them below ``folder``, and yield their outcomes.

    ``limits``: the time of a run is limited here, its memory by the cluster's own limit. ``again``: retry stored failures. When
    the generator is closed, runs on the cluster are cancelled.

    Raises InputError if ``distributed`` is not installed, the scheduler does not answer, it has no workers, or a worker has other
    code or other libraries; RunFailedError if the scheduler disappears; StoreError if the store cannot be written.
    """
    distributed = _import()
    with ExitStack() as stack:
        try:
            client = stack.enter_context(distributed.Client(scheduler, timeout=CONNECT, set_as_default=False))
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(
                f"--scheduler is {quoted(scheduler)}: no scheduler answers there: {told(error)}"
            ) from error
        if not client.nthreads():
            raise InputError(f"--scheduler is {quoted(scheduler)}: it has no workers")
        cluster = _Cluster(distributed, client, Store(folder), limits, again)
        stack.callback(cluster.close)
        try:
            yield from cluster.outcomes(runs)
        except (OSError, distributed.CancelledError) as error:  # connection errors: those of the store are StoreErrors
            raise RunFailedError(
                "the scheduler has disappeared; results are stored, the same command continues"
            ) from error


def make(run: PlannedRun, version: str, seconds: float) -> _Made:
    """Compute a run on a worker, if its code and libraries have the digest ``version``, in at most ``seconds``."""
    import cv2  # noqa: PLC0415
    from distributed import get_worker  # noqa: PLC0415

    cv2.setNumThreads(1)
    address = str(get_worker().address)
    if version != version_here():
        raise InputError(
            f"{address}: this worker has another version of the code, or of a library, than the experiment"
        )
    made: SimpleQueue[dict[str, bytes] | FglocError] = SimpleQueue()

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
            return _Made(_failure("timeout", f"it took more than {seconds:g} s"), late=address)
    if isinstance(files, FglocError):
        raise files
    return _Made(files)


@lru_cache
def version_here() -> str:
    """A digest of the code and the libraries of this process."""
    return digest_of([code_version(), library_versions()])


class _Cluster:
    def __init__(self, distributed: ModuleType, client: Any, store: Store, limits: Limits, again: bool) -> None:
        self._distributed, self._client, self._store = distributed, client, store
        self._seconds, self._again = limits.time, again
        self._session = uuid4().hex  # for unique keys: a scheduler returns the stored result of a key, even a failure
        self._waiting: deque[PlannedRun] = deque()
        self._busy: list[PlannedRun] = []  # claimed by another process
        self._sent: dict[Any, _Sent] = {}

    def outcomes(self, runs: Sequence[PlannedRun]) -> Iterator[Outcome]:
        self._waiting.extend(runs)
        looked = time.monotonic()
        while self._waiting or self._busy or self._sent:
            yield from self._send()
            for future in self._done():
                yield self._receive(future)
            if time.monotonic() - looked > LOOK:
                self._waiting.extend(self._busy)
                self._busy, looked = [], time.monotonic()

    def close(self) -> None:
        with suppress(Exception):  # the scheduler may be gone
            self._client.cancel(list(self._sent), force=True)
        for sent in self._sent.values():
            sent.claim.close()

    def _send(self) -> Iterator[Outcome]:
        room = AHEAD * max(1, sum(self._client.nthreads().values()))
        while self._waiting and len(self._sent) < room:
            run = self._waiting.popleft()
            claim = ExitStack()
            if not claim.enter_context(self._store.claim(run.key)):
                claim.close()
                self._busy.append(run)
                continue
            state = self._store.state(run.key, thorough=True)
            if state == "ok" or (state == "failed" and not self._again):
                claim.close()
                yield stored_outcome(run.key, self._store)
                continue
            findable = replace(run, source=_absolute(run.source))
            key = f"fgloc-{run.key}-{self._session}"
            future = self._client.submit(make, findable, version_here(), self._seconds, key=key, pure=False)
            self._sent[future] = _Sent(run, claim)

    def _done(self) -> list[Any]:
        if not self._sent:
            time.sleep(LOOK)
            return []
        futures = list(self._sent)
        try:
            with self._client.as_current():
                return list(self._distributed.wait(futures, timeout=LOOK, return_when="FIRST_COMPLETED").done)
        except TimeoutError:
            return []

    def _receive(self, future: Any) -> Outcome:
        sent = self._sent.pop(future)
        with sent.claim:
            made = self._result(future)
            self._store.put(sent.run.key, made.files)
        if made.late is not None:
            with suppress(Exception):  # a worker without a nanny continues with that run
                self._client.restart_workers([made.late], timeout=RESTART, raise_for_error=False)
        return stored_outcome(sent.run.key, self._store)

    def _result(self, future: Any) -> _Made:
        if future.status != "error":
            made = future.result()
            assert isinstance(made, _Made)
            return made
        error = future.exception()
        if isinstance(error, self._distributed.KilledWorker):
            return _Made(_failure("killed", "the workers that were given it died, one after the other"))
        if isinstance(error, FglocError):
            raise error
        raise RunFailedError(f"a worker could not make a run: {type(error).__name__}: {told(error)}") from error


def _failure(kind: Kind, reason: str) -> dict[str, bytes]:
    return {FAILURE: failure_file(kind, reason)}


def _absolute(source: LogSource) -> LogSource:
    """The source with absolute paths, independent of the worker's working folder."""

    def path(name: str) -> str:
        return str(Path(name).resolve()) if Path(name).exists() else name

    if isinstance(source, SimulatedSource):
        return replace(source, preset=path(source.preset))
    root = source.data_root or os.environ.get("FGLOC_DATA")
    return replace(
        source,
        log=path(source.log),
        rig=None if source.rig is None else path(source.rig),
        world=None if source.world is None else path(source.world),
        data_root=None if not root else str(Path(root).resolve()),
    )


def _import() -> ModuleType:
    try:
        import distributed  # noqa: PLC0415
    except ImportError as error:
        raise InputError(
            "--scheduler needs the package distributed, which is not installed: pip install 'factorgraph-loc[cluster]'"
        ) from error
    return distributed
