"""Each job in a process of its own, so that one that dies takes nothing with it and its peak memory is its own."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.experiments.threads import use_one_thread

Job = TypeVar("Job")
Value = TypeVar("Value")


class ProcessDiedError(RunFailedError):
    """A process ended without a result: killed, out of memory, or a crash in native code."""


def run_each(
    function: Callable[[Job], Value], jobs: Sequence[Job], workers: int
) -> Iterator[tuple[int, Value | Exception]]:
    """Call ``function`` on each job, at most ``workers`` at a time, and yield index and outcome as they come.

    An exception is an outcome like any other. Function, jobs and values must be picklable; the processes are spawned, so a
    script that calls this needs the usual ``if __name__ == "__main__"``.
    """
    use_one_thread()
    context = multiprocessing.get_context("spawn")

    def call(job: Job) -> Value | Exception:
        # a pool of one per job: a shared pool would break for all jobs when one process dies
        try:
            with ProcessPoolExecutor(1, mp_context=context) as pool:
                return pool.submit(function, job).result()
        except BrokenProcessPool:
            return ProcessDiedError(
                "the process died without a word (killed, out of memory, or a crash in native code)"
            )
        except Exception as error:
            return error

    threads = ThreadPoolExecutor(max_workers=workers)
    try:
        futures: dict[Any, int] = {threads.submit(call, job): i for i, job in enumerate(jobs)}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        threads.shutdown(cancel_futures=True)
