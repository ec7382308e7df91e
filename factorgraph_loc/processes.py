"""Processes that this one starts, all in one place: each ends with the process that started it, however that one ends.

What this module imports must be light: it is the first that a new process loads, and the last before it is tied to its parent.
"""

import ctypes
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
from typing import Any, TypeVar

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.threads import use_one_thread

BEAT = 0.3  # s between two calls of what wants to be called while jobs are made
READY = "ready"
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # by which a user or the system ends a command
_PR_SET_PDEATHSIG = 1  # prctl(2)

Job = TypeVar("Job")
Value = TypeVar("Value")


class ProcessDiedError(RunFailedError):
    """A process ended without a result: killed, out of memory, or a crash in native code."""


class Child(SpawnProcess):
    """A spawned process that ends with its parent, and may have children of its own, which end with it."""

    def run(self) -> None:
        _end_with_parent()
        self.daemon = False  # it has been told by now; what is a daemon may not start processes
        super().run()


@dataclass(eq=False)
class Started:
    """A process, this end of the connection that its function was given, and the index of the job that it makes, if any."""

    process: Child
    connection: Connection
    ready: bool = False
    at: int | None = None

    def end(self) -> None:
        """End it, whatever it does."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def start(function: Callable[..., None], *args: Any) -> tuple[Child, Connection]:
    """Start a process that calls ``function`` with a connection and ``args``; it, and this end of the connection.

    It is spawned, so a script needs the usual ``if __name__ == "__main__"``. The module of ``function`` must be light: the process
    is not tied to this one before it has loaded that. An interrupt from the keyboard is not for it but for this process.
    """
    use_one_thread()
    here, there = Pipe()
    process = Child(target=function, args=(there, *args), daemon=True)
    with _undisturbed():
        process.start()
    there.close()
    return process, here


def run_each(
    function: Callable[[Job], Value],
    jobs: Sequence[Job],
    workers: int,
    *,
    lasting: bool = False,
    beat: Callable[[], None] | None = None,
) -> Iterator[tuple[int, Value | Exception]]:
    """Call ``function`` on each job, in at most ``workers`` processes at a time, and yield index and outcome as they come.

    An exception is an outcome like any other. Each job has a process of its own, so that one that dies takes nothing with it and
    its peak memory is its own; with ``lasting`` a process makes several, and loads what is slow to load once. ``beat`` is called
    every :data:`BEAT` seconds, if given. When the caller stops listening, the processes end at once. Function, jobs and values
    must be picklable; the processes are spawned, so a script that calls this needs the usual ``if __name__ == "__main__"``.
    """
    waiting = deque(range(len(jobs)))
    team: list[Started] = []
    try:
        while waiting or any(worker.at is not None for worker in team):
            while len(team) < workers and sum(worker.at is None for worker in team) < len(waiting):
                worker = Started(*start(_serve))
                team.append(worker)
                _send(worker, function)
            for connection in wait([worker.connection for worker in team], None if beat is None else BEAT):
                worker = next(worker for worker in team if worker.connection is connection)
                heard = _hear(worker)
                if isinstance(heard, ProcessDiedError) and worker.at is None and waiting:  # before it began
                    worker.at = waiting.popleft()
                at, worker.at = worker.at, None
                if isinstance(heard, ProcessDiedError) or (at is not None and not lasting):
                    team.remove(worker)
                    worker.end()
                elif waiting:
                    worker.at = waiting.popleft()
                    _send(worker, jobs[worker.at])
                if at is not None:
                    yield at, heard
            if beat is not None:
                beat()
    finally:
        for worker in team:
            worker.end()


def _send(worker: Started, content: object) -> None:
    with suppress(OSError):  # it has died, which the next look tells
        worker.connection.send(content)


def _hear(worker: Started) -> Any:
    """What a process says: ``READY``, a value, or the exception of its job."""
    try:
        heard, told = worker.connection.recv()
    except (EOFError, OSError):
        return ProcessDiedError("the process died without a word (killed, out of memory, or a crash in native code)")
    if told:
        heard.__cause__ = RemoteError(told)
    return heard


class RemoteError(Exception):
    """Where an exception was raised in another process, as the cause of that exception here."""

    def __str__(self) -> str:
        return f'\n"""\n{self.args[0]}"""'


def _serve(connection: Connection) -> None:
    """Take a function, then answer each job that comes with what the function makes of it."""
    function = connection.recv()
    connection.send((READY, ""))
    while True:
        try:
            job = connection.recv()
        except EOFError:
            return
        try:
            answer = function(job), ""
        except Exception as error:  # any fault of a job is its outcome
            answer = _portable(error), "".join(traceback.format_exception(error))
        try:
            connection.send(answer)
        except (pickle.PicklingError, TypeError, AttributeError) as error:  # nothing was sent of what cannot be
            connection.send((_portable(error), "".join(traceback.format_exception(error))))


def _portable(error: Exception) -> Exception:
    """The exception, or one that says the same where it cannot be sent."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # whatever the constructor of another's exception may raise
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _end_with_parent() -> None:
    """End this process within moments of its parent's end.

    A thread waits for that; where another holds the interpreter for long, in native code, the kernel ends the process, if it can.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent.pid:  # it ended before the kernel was told
            os._exit(1)

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _undisturbed() -> Iterator[None]:
    """What starts meanwhile never hears of an interrupt from the keyboard; this process hears of signals afterwards, as one that
    is half started would complain."""
    resource_tracker.ensure_running()  # it is started with the first process, and would let interrupts through
    came: list[int] = []
    before = {}
    if threading.current_thread() is threading.main_thread():
        handlers = {one: signal.getsignal(one) for one in STOPS}
        before = {one: handler for one, handler in handlers.items() if callable(handler)}
        for one in before:
            signal.signal(one, lambda number, _: came.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for one, handler in before.items():
            signal.signal(one, handler)
        for number in came:
            signal.raise_signal(number)
