"""What a run leaves behind: the causal estimates, the final trajectory, and what was counted and timed on the way."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgraph_loc.model.belief import Status
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.learnt import Learnt
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.trajectory3 import Trajectory3
from factors.se2 import Array


@dataclass(frozen=True)
class Timings:
    """Wall-clock times.

    ``update_t`` (M,) [s from the log's start]: stamps with an exteroceptive measurement; ``update_ms`` (M,): what each took,
    the ``estimate()`` after it included. ``causal_seconds``: the whole causal loop, odometry and ticks included;
    ``real_time_factor``: the log's span over that. ``final_seconds``: the making of the final trajectory.
    ``peak_memory_mb``: the largest resident memory of the process so far, in 10^6 bytes. ``frontend_seconds``: before the loop,
    how long it took until the features of ``images`` were there, found or from the cache.
    """

    update_t: Array
    update_ms: Array
    causal_seconds: float
    real_time_factor: float
    final_seconds: float
    peak_memory_mb: float
    images: int = 0
    frontend_seconds: float = 0.0


@dataclass(frozen=True)
class RunResult:
    """One log run by one estimator.

    ``config``: the effective configuration as plain values, enough to repeat the run. ``t`` (N,), ``poses`` (N, 3),
    ``covariances`` (N, 3, 3) in the world's frame and ``status`` (N) are the causal estimates on the grid of ticks;
    ``final`` is the best estimate of the whole past. ``causal_space``, ``final_space``: the same in space, of an estimator that
    knows it.
    """

    log: str
    config: Mapping[str, Any]
    t: Array
    poses: Array
    covariances: Array
    status: tuple[Status, ...]
    final: Trajectory
    diagnostics: Diagnostics
    learnt: Learnt
    timings: Timings
    versions: Mapping[str, str]
    warnings: tuple[str, ...] = ()
    causal_space: Trajectory3 | None = None
    final_space: Trajectory3 | None = None

    @property
    def max_gap(self) -> float:
        """The time [s] between estimates that are interpolated where they are scored."""
        return float(self.config.get("max_gap", MAX_GAP))

    def first_localized(self) -> int | None:
        """Index of the first causal estimate that is localized, or None if none is."""
        found = np.flatnonzero(np.array(self.status) == "localized")
        return int(found[0]) if len(found) else None

    def causal(self) -> Trajectory | None:
        """The causal estimates from the first localized one on, or None if there is none."""
        first = self.first_localized()
        if first is None:
            return None
        return Trajectory(self.t[first:], self.poses[first:], self.covariances[first:])
