"""Errors of several estimators on a simulated log. Only the errors are stored, not the results of the runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.evaluation.metrics import errors
from factorgraph_loc.evaluation.pairing import thinned
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.belief import Status
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult, Timings
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.simulation import simulate
from factorgraph_loc.simulation.settings import SimulationSettings
from factors.se2 import Array


@dataclass(frozen=True)
class Series:
    """The errors of a trajectory at N stamps of the reference. They are NaN where the trajectory has no pose.

    ``t`` (N,) [s]. ``position`` (N,) [m], ``heading`` (N,) [rad]: absolute errors. ``nees`` (N,): normalised squared errors of
    the pose.
    """

    t: Array
    position: Array
    heading: Array
    nees: Array

    def position_rmse(self) -> float:
        return float(np.sqrt(np.nanmean(np.square(self.position))))

    def heading_rmse(self) -> float:
        return float(np.sqrt(np.nanmean(np.square(self.heading))))

    def where(self, keep: NDArray[np.bool_]) -> Series:
        """Return the errors at the times of the mask ``keep`` (N,)."""
        return Series(self.t[keep], self.position[keep], self.heading[keep], self.nees[keep])


@dataclass(frozen=True)
class RunErrors:
    """The errors of one run.

    ``causal``: of the estimates during the run, NaN before the first localized one. ``final``: of the final trajectory.
    ``status``: at each tick.
    """

    causal: Series
    final: Series
    status: tuple[Status, ...]
    timings: Timings

    def share(self, status: Status) -> float:
        """Return the fraction of the ticks with this status."""
        return self.status.count(status) / len(self.status)


def run_ensemble(
    settings: SimulationSettings,
    seed: int,
    configs: Mapping[str, RunConfig],
    change: Callable[[Log, int], Log] = lambda log, _: log,
) -> dict[str, RunErrors]:
    """Simulate a log, run estimators on it, and return their errors by label.

    ``configs``: the runs by label. ``change``: a function that changes the log before the runs. Its arguments are log and seed.
    """
    log = change(simulate(settings, seed), seed)
    return {label: run_errors(run(log, config), log) for label, config in configs.items()}


def run_errors(result: RunResult, log: Log) -> RunErrors:
    """Return the errors of a run on a log with a reference."""
    causal = result.causal() or Trajectory(np.empty(0), np.empty((0, 3)))
    gap = result.max_gap
    return RunErrors(series(causal, log, gap), series(result.final, log, gap), result.status, result.timings)


def series(trajectory: Trajectory, log: Log, max_gap: float = MAX_GAP) -> Series:
    """Return the errors of a trajectory relative to the reference of its log
    (:func:`~factorgraph_loc.evaluation.metrics.errors`)."""
    assert log.reference is not None, "a log to score has a reference"
    e = errors(trajectory, log.reference, max_gap)
    t = log.reference.t[thinned(log.reference.t)]
    columns = np.full((3, len(t)), np.nan)
    columns[:, np.searchsorted(t, e.t)] = e.position, e.heading, e.nees
    return Series(t, *columns)


def stacked(runs: Sequence[Series]) -> Array:
    """Return the NEES (R, N) of R runs at their first N times. N is the number of times of the shortest run."""
    count = min(len(one.nees) for one in runs)
    return np.stack([one.nees[:count] for one in runs])
