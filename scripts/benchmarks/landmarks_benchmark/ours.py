"""Workloads whose processor time is measured: estimators of this project, and reference programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import process_time
from typing import TypeVar
from unittest.mock import patch

import numpy as np

from factorgraph_loc.experiments.causal_run import rare_garbage_collection
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
    """The processor times of a workload. ``seconds``: the total. ``update_ms`` (M,): of each update. ``position`` [m]: the
    position RMSE of its estimates."""

    seconds: float
    update_ms: Array = field(default_factory=lambda: np.empty(0))
    position: float = np.nan


Work = Callable[[], Times]
Name = TypeVar("Name")


def timed_loop(loop: Loop, problem: Problem) -> Work:
    """Return the workload of a reference program. A workload is a function that runs it once and returns its times."""

    def work() -> Times:
        # Runs of this project collect garbage rarely. Without the same here, collections over the objects of this project's modules
        # would take a quarter of the program's time.
        with rare_garbage_collection():
            started = process_time()
            found = loop(problem)
            seconds = process_time() - started
        return Times(seconds, 1e3 * np.array(found.updates), problem.position_rmse(found.t, found.poses))

    return work


def timed_run(log: Log, config: RunConfig, problem: Problem | None = None) -> Work:
    """Return the workload of an estimator of this project. With ``problem``, which has the true poses, its error is computed
    too."""

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
    """Return the processor time [s] of the loop over the measurements. For estimators that solve the whole problem at the end,
    the time of the final trajectory is added."""
    estimator, settings = result.config["estimator"], result.config["settings"]
    whole = estimator == "batch" or (estimator == "smoother" and settings.get("lag") is None)
    return result.timings.causal_seconds + (result.timings.final_seconds if whole else 0.0)


def least(pairs: Mapping[Name, tuple[Work, Work]], rounds: int) -> dict[Name, tuple[Times, Times]]:
    """Run pairs of workloads several times in turn. Returns the smallest times of both workloads of each pair.

    Before the measured ``rounds``, each workload runs once, so that compilation is not measured.
    """
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
