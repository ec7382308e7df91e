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
    """A comparison of a sensor's number of detections with the number that its model predicts, in G groups.

    ``what``: the plural name of the detections. ``groups`` (G,): names of the groups of measurements. ``observed``,
    ``predicted`` (G,): counts of detections. ``sigma`` (G,): standard deviation of ``observed`` if the model is
    correct, for correlated successive measurements. ``overdispersion``: number of correlated measurements that have the
    information of one independent measurement.
    """

    what: str
    groups: Sequence[str]
    observed: Array
    predicted: Array
    sigma: Array
    overdispersion: float


@dataclass(frozen=True)
class Timings:
    """Computing times and memory of a run.

    ``update_t`` (M,): timestamps of measurements except odometry [s from the start of the log]. ``update_ms`` (M,):
    computing time of each of these updates and of the estimate that follows [ms]. ``causal_seconds``: computing time of
    all measurements and of the estimates during the run [s]. ``real_time_factor``: the duration of the log divided by
    ``causal_seconds``. ``final_seconds``: computing time of the final trajectory [s]. ``peak_memory_mb``: peak resident
    memory of the process so far [10^6 bytes]. ``images``: number of images. ``frontend_seconds``: time to detect their
    features before the run, or to load them from the cache [s].
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

    ``log``: the name of the log. ``config``: the effective configuration, enough to repeat the run. ``t`` (N,) [s],
    ``poses`` (N, 3), ``covariances`` (N, 3, 3), ``status`` (N): the causal estimates, in the world frame. An estimate
    is causal if it uses only earlier measurements. ``final``: the trajectory that is estimated from the whole log.
    ``learnt``: estimated sensor constants and landmarks. ``reliability``: by sensor, a comparison of observed and
    predicted detections. ``doubts_model`` (N): True where measurements contradicted the model of their sensor.
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
        """The longest gap [s] between two estimates that a comparison with the reference interpolates."""
        return float(self.config.get("max_gap", MAX_GAP))

    def first_localized(self) -> int | None:
        """Return the index of the first causal estimate with the status ``localized``, or None if there is none."""
        localized = np.flatnonzero(np.array(self.status) == "localized")
        return int(localized[0]) if len(localized) else None

    def causal(self) -> Trajectory | None:
        """Return the causal estimates from the first localized one on as a trajectory. Return None if none is
        localized."""
        first = self.first_localized()
        if first is None:
            return None
        return Trajectory(self.t[first:], self.poses[first:], self.covariances[first:])
