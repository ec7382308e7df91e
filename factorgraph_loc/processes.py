"""Child processes that always end with their parent, however it ends.

This module must import light modules only: a new process loads it before it is tied to its parent.
"""

import ctypes
import gc
import importlib
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, Pipe, wait
from multiprocessing.context import SpawnProcess
from types import ModuleType
from typing import Any, TypeVar

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.threads import use_one_thread

BEAT = 0.3  # s between two calls of the heartbeat function
READY = "ready"
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # signals that end a command
_PR_SET_PDEATHSIG = 1  # prctl(2)

Job = TypeVar("Job")
Value = TypeVar("Value")


class ProcessDiedError(RunFailedError):
    """A process ended without a result: it was killed, ran out of memory, or crashed in native code."""


class Child(SpawnProcess):
    """A spawned process that ends with its parent, and searches for garbage as rarely; its own children end with it."""

    def start(self) -> None:
        self._threshold = gc.get_threshold()
        super().start()

    def run(self) -> None:
        _end_with_parent()
        gc.set_threshold(*self._threshold)
        self.daemon = False  # a daemon could not start processes of its own
        super().run()


@dataclass(eq=False)
class Worker:
    """A worker process, the parent's end of its connection, whether it has loaded its modules, and its current job or None."""

    process: Child
    connection: Connection
    ready: bool = False
    job: Any = None

    def send(self, content: object) -> None:
        """Send the function first, then a job at a time."""
        with suppress(OSError):  # it has died; the next `hear` reports that
            self.connection.send(content)

    def hear(self) -> Any:
        """Receive ``READY``, a value, or the exception of the job; a ProcessDiedError if the process has ended."""
        try:
            answer, traceback_text = self.connection.recv()
        except (EOFError, OSError):
            return ProcessDiedError("the process died (killed, out of memory, or a crash in native code)")
        self.ready = True
        if traceback_text:
            answer.__cause__ = RemoteError(traceback_text)
        return answer

    def end(self) -> None:
        """Kill the process."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def start(function: Callable[..., None], *args: Any) -> tuple[Child, Connection]:
    """Spawn a process that calls ``function(connection, *args)``. Returns the process and the parent's end of the connection.

    The process does not import the script that starts it, so ``function`` must be of a module. That must be light, because the
    process is tied to this one only after loading it. The process ignores keyboard interrupts.
    """
    use_one_thread()
    parent_end, child_end = Pipe()
    process = Child(target=function, args=(child_end, *args), daemon=True)
    with _undisturbed(), _without_script():
        process.start()
    child_end.close()
    return process, parent_end


def run_each(
    function: Callable[[Job], Value],
    jobs: Sequence[Job],
    workers: int,
    *,
    beat: Callable[[], None] | None = None,
) -> Iterator[tuple[int, Value | Exception]]:
    """Call ``function`` on each job in at most ``workers`` processes. Yields (index, value or exception) as jobs finish.

    Each job runs in a process of its own, so a crash affects that job only and peak memory is measured per job. ``beat`` is
    called every :data:`BEAT` seconds. Closing the iterator ends the processes. Function, jobs and values must be picklable, and of
    modules that can be imported.
    """
    waiting = deque(range(len(jobs)))
    team: list[Worker] = []
    try:
        while waiting or any(worker.job is not None for worker in team):
            while len(team) < workers and sum(worker.job is None for worker in team) < len(waiting):
                worker = Worker(*start(serve))
                team.append(worker)
                worker.send(function)
            for connection in wait([worker.connection for worker in team], None if beat is None else BEAT):
                worker = next(worker for worker in team if worker.connection is connection)
                answer = worker.hear()
                if isinstance(answer, ProcessDiedError) and worker.job is None and waiting:  # died before its first job
                    worker.job = waiting.popleft()
                at, worker.job = worker.job, None
                if isinstance(answer, ProcessDiedError) or at is not None:
                    team.remove(worker)
                    worker.end()
                elif waiting:
                    worker.job = waiting.popleft()
                    worker.send(jobs[worker.job])
                if at is not None:
                    yield at, answer
            if beat is not None:
                beat()
    finally:
        for worker in team:
            worker.end()


class RemoteError(Exception):
    """The traceback of an exception from another process, attached as its cause."""

    def __str__(self) -> str:
        return f'\n"""\n{self.args[0]}"""'


def serve(connection: Connection, *modules: str) -> None:
    """Main loop of a worker: import ``modules``, receive a function, then answer each job with its value or exception."""
    for name in modules:
        importlib.import_module(name)
    function = connection.recv()
    connection.send((READY, ""))
    while True:
        try:
            job = connection.recv()
        except EOFError:
            return
        try:
            answer = function(job), ""
        except Exception as error:  # a failure is the job's outcome
            answer = _portable(error), "".join(traceback.format_exception(error))
        try:
            connection.send(answer)
        except (
            pickle.PicklingError,
            TypeError,
            AttributeError,
        ) as error:  # the value cannot be pickled; nothing was sent
            connection.send((_portable(error), "".join(traceback.format_exception(error))))


def _portable(error: Exception) -> Exception:
    """The exception if it can be pickled, else a RuntimeError with the same message."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # constructors of foreign exceptions may raise anything
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _end_with_parent() -> None:
    """End this process when its parent ends: by a waiting thread, and on Linux by the kernel, as native code may block the
    thread."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent.pid:  # the parent ended before the call above
            os._exit(1)

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _without_script() -> Iterator[None]:
    """Start processes that do not import the script that is running: it needs no ``if __name__ == "__main__"``."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Start processes that ignore keyboard interrupts; signals to this process are deferred until the block ends."""
    resource_tracker.ensure_running()  # otherwise it is started with the first process, and unblocks interrupts
    came: list[int] = []
    replaced = {}
    if threading.current_thread() is threading.main_thread():
        handlers = {signum: signal.getsignal(signum) for signum in STOPS}
        replaced = {signum: handler for signum, handler in handlers.items() if callable(handler)}
        for signum in replaced:
            signal.signal(signum, lambda number, _: came.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for signum, handler in replaced.items():
            signal.signal(signum, handler)
        for number in came:
            signal.raise_signal(number)
