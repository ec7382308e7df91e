"""Child processes that always end with their parent process, also if the parent is killed.

This module must import only modules that load fast, because a new process can outlive its parent until it has loaded them.
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

BEAT = 0.3  # s between two calls of the argument ``beat`` of ``run_each``
READY = "ready"  # message of a worker process that has loaded its modules
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # signals that end a command
_PR_SET_PDEATHSIG = 1  # prctl(2)

Job = TypeVar("Job")
Value = TypeVar("Value")


class ProcessDiedError(RunFailedError):
    """A process ended without a result: it was killed, ran out of memory, or crashed in native code."""


class Child(SpawnProcess):
    """A spawned process that ends when its parent ends. It has the garbage collection thresholds of its parent."""

    def start(self) -> None:
        self._threshold = gc.get_threshold()
        super().start()

    def run(self) -> None:
        _end_with_parent()
        gc.set_threshold(*self._threshold)
        self.daemon = False  # a daemonic process may not start processes
        super().run()


@dataclass(eq=False)
class Worker:
    """A worker process of :func:`run_each`.

    ``process``: the process. ``connection``: this process's end of the pipe to it. ``ready``: whether it has loaded its
    modules. ``job``: the index of its current job, or None.
    """

    process: Child
    connection: Connection
    ready: bool = False
    job: Any = None

    def send(self, content: object) -> None:
        """Send ``content`` to the process. The first object must be the function, each later one is a job."""
        with suppress(OSError):  # `receive` reports that the process has died
            self.connection.send(content)

    def receive(self) -> Any:
        """Wait for the next answer of the process and return it. Return a ProcessDiedError if the process has ended.

        The answer is ``READY``, the value of the job, or the exception that the job raised.
        """
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
    """Start a process that calls ``function(connection, *args)``. Return the process, and this end of a pipe to it.

    ``connection`` is the other end of the pipe. ``function`` must be defined in a module that can be imported, not in
    the running script. The new process ignores keyboard interrupts.
    """
    use_one_thread()
    parent_end, child_end = Pipe()
    process = Child(target=function, args=(child_end, *args), daemon=True)
    with _ignoring_interrupts(), _without_script():
        process.start()
    child_end.close()
    return process, parent_end


def run_each(
    function: Callable[[Job], Value], jobs: Sequence[Job], workers: int, *, beat: Callable[[], None] | None = None
) -> Iterator[tuple[int, Value | Exception]]:
    """Call ``function`` on each job in at most ``workers`` parallel processes. A crash affects only one job.

    When a job ends, yield its index in ``jobs``, and the value that ``function`` returned or the exception that it
    raised. ``beat`` is called about every :data:`BEAT` seconds. Closing the iterator kills the processes. The function,
    the jobs and the values must be picklable, and their classes must be defined in modules that can be imported.
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
                answer = worker.receive()
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
    """The ``__cause__`` of an exception that another process raised. It displays the traceback in that process."""

    def __str__(self) -> str:
        return f'\n"""\n{self.args[0]}"""'


def serve(connection: Connection, *modules: str) -> None:
    """Run the main loop of a worker process. ``connection``: its end of a pipe. ``modules``: names of modules to import
    first.

    The process receives a function from ``connection``, and then jobs. It calls the function on each job, and sends the
    value or the exception back.
    """
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
        except Exception as error:  # the parent handles failures of jobs
            answer = _portable(error), "".join(traceback.format_exception(error))
        try:
            connection.send(answer)
        except (pickle.PicklingError, TypeError, AttributeError) as error:  # the value cannot be pickled
            connection.send((_portable(error), "".join(traceback.format_exception(error))))


def _portable(error: Exception) -> Exception:
    """Return the exception if it can be pickled, or else a RuntimeError with the same message."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # constructors of foreign exceptions may raise anything
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _end_with_parent() -> None:
    """Make this process end when its parent process ends. On Linux this works also while native code blocks threads."""
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
    """Prevent new processes from importing the running script. The script then needs no ``if __name__ == "__main__"``."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


@contextmanager
def _ignoring_interrupts() -> Iterator[None]:
    """Make processes that start in this block ignore keyboard interrupts. Delay signals to this process meanwhile."""
    resource_tracker.ensure_running()  # its start unblocks keyboard interrupts, so it must not start in the block
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
