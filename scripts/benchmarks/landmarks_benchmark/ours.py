"""What is measured: a workload returns its processor time, and those of this project beside the references."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import process_time
from typing import TypeVar
from unittest.mock import patch

import numpy as np

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult
from factors.se2 import Array
from landmarks_benchmark.programs.plain import Loop, Problem

LOG = "mrclam6-robot3"
RUNS = "factorgraph_loc.experiments"
PARTICLES = 5000
PLAIN = {"self_calibration": False}
CONFIGS: Mapping[str, RunConfig] = {
    "EKF": RunConfig("ekf", PLAIN),
    "EKF, 5 constants": RunConfig("ekf"),
    "smoother, lag 10 s, 5 constants": RunConfig("smoother", {"lag": 10.0}),
    "smoother, 5 constants": RunConfig("smoother"),
    "smoother, full history, 5 constants": RunConfig("smoother", {"lag": "all"}),
    "particle filter, 5,000": RunConfig("particle_filter", {**PLAIN, "particles": PARTICLES}),
    "batch": RunConfig("batch", PLAIN),
}


@dataclass(frozen=True)
class Times:
    """Processor times: ``seconds`` of a workload, ``update_ms`` (M,) of its updates; ``position`` [m]: its RMSE."""

    seconds: float
    update_ms: Array = field(default_factory=lambda: np.empty(0))
    position: float = np.nan


Work = Callable[[], Times]
Name = TypeVar("Name")


def timed_loop(loop: Loop, problem: Problem) -> Work:
    """The workload of a reference program."""

    def work() -> Times:
        started = process_time()
        found = loop(problem)
        seconds = process_time() - started
        return Times(seconds, 1e3 * np.array(found.updates), problem.position_rmse(found.t, found.poses))

    return work


def timed_run(log: Log, config: RunConfig, problem: Problem | None = None) -> Work:
    """The workload of an estimator; its error is known with the problem of the log."""

    def work() -> Times:
        with patch(f"{RUNS}.run.perf_counter", process_time), patch(f"{RUNS}.causal_run.perf_counter", process_time):
            result = run(log, config)
        if problem is None:
            return Times(seconds_of(result), result.timings.update_ms)
        if config.estimator == "batch":
            return Times(seconds_of(result), position=problem.position_rmse(result.final.t, result.final.poses))
        return Times(seconds_of(result), result.timings.update_ms, problem.position_rmse(result.t, result.poses))

    return work


def seconds_of(result: RunResult) -> float:
    """Of the loop over the measurements; and to the final trajectory, where the whole problem is solved for it."""
    estimator, settings = result.config["estimator"], result.config["settings"]
    whole = estimator == "batch" or (estimator == "smoother" and settings.get("lag") is None)
    return result.timings.causal_seconds + (result.timings.final_seconds if whole else 0.0)


def least(pairs: Mapping[Name, tuple[Work, Work]], rounds: int) -> dict[Name, tuple[Times, Times]]:
    """The least times of both workloads of each pair. A round before, which compiles, does not count."""
    found: dict[Name, tuple[list[Times], list[Times]]] = {name: ([], []) for name in pairs}
    for i in range(rounds + 1):
        for name, works in pairs.items():
            for work, times in zip(works, found[name], strict=True):
                taken = work()
                if i:
                    times.append(taken)
    return {name: (min(ours, key=_seconds), min(others, key=_seconds)) for name, (ours, others) in found.items()}


def _seconds(times: Times) -> float:
    return times.seconds
