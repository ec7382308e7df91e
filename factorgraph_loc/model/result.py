"""The result of a run: causal estimates, final trajectory, diagnostics and timings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from factorgraph_loc.model.belief import Learnt, Status
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.text import Notice
from factors.se2 import Array


@dataclass(frozen=True, eq=False)
class Reliability:
    """Detections of one sensor that were observed and predicted, in G groups of measurements.

    ``what``: plural of the detections; ``groups`` (G,): their names; ``observed``, ``predicted`` and ``sigma`` (G,): counts, and
    the standard deviation of the observed one for a correct model, with the correlation of successive measurements.
    ``overdispersion``: number of measurements that contain the information of one independent one.
    """

    what: str
    groups: Sequence[str]
    observed: Array
    predicted: Array
    sigma: Array
    overdispersion: float


@dataclass(frozen=True)
class Timings:
    """Wall-clock times.

    ``update_t`` (M,) [s from the log's start]: timestamps with an exteroceptive measurement; ``update_ms`` (M,): time of each
    update, including the following ``estimate()``. ``causal_seconds``: the whole causal loop, including odometry and ticks;
    ``real_time_factor``: the log's duration divided by that. ``final_seconds``: time to compute the final trajectory.
    ``peak_memory_mb``: peak resident memory of the process so far, in 10^6 bytes. ``frontend_seconds``: time to detect the
    features of ``images``, or to load them from the cache, before the loop.
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
    """The result of one estimator on one log.

    ``config``: the effective configuration, enough to repeat the run. ``t`` (N,), ``poses`` (N, 3), ``covariances`` (N, 3, 3) in
    the world frame, ``status`` (N): the causal estimates at the ticks. ``doubts_model`` (N): whether measurements contradicted
    the model of their sensor. ``final``: the estimate from the whole log. ``reliability``: of the sensors' models on this log, by
    sensor.
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
    warnings: tuple[Notice, ...] = ()
    reliability: Mapping[str, Reliability] = field(default_factory=dict)
    doubts_model: tuple[bool, ...] = ()

    def __repr__(self) -> str:
        poses = f"{len(self.t)} causal and {len(self.final)} final poses"
        return f"RunResult(log={self.log!r}, estimator={self.config.get('estimator')!r}, {poses})"

    @property
    def max_gap(self) -> float:
        """The longest time [s] between estimates across which scoring interpolates."""
        return float(self.config.get("max_gap", MAX_GAP))

    def first_localized(self) -> int | None:
        """Index of the first causal estimate that is localized, or None if none is."""
        localized = np.flatnonzero(np.array(self.status) == "localized")
        return int(localized[0]) if len(localized) else None

    def causal(self) -> Trajectory | None:
        """The causal estimates from the first localized one, or None if there is none."""
        first = self.first_localized()
        if first is None:
            return None
        return Trajectory(self.t[first:], self.poses[first:], self.covariances[first:])
