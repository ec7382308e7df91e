"""The particles of a stored run, which are not stored with it, by repeating the run from its configuration."""

from collections.abc import Callable

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.experiments.run import run as run_log
from factorgraph_loc.exports.runs import Particles, StoredRun
from factorgraph_loc.fusion.base import Estimator
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factors.se2 import Array

OF_PARTICLES = ("particle_filter", "switching")
SHOWN = 500  # maximum number of particles per time
INTERVAL = 0.5  # s between the times


def particles_of(run: StoredRun, log: Log, progress: Callable[[float], None] | None = None) -> Particles | None:
    """The particles of a run of ``log``; None if the estimator has none. Raises InputError if the run cannot be repeated."""
    if run.folder.estimator not in OF_PARTICLES:
        return None
    kept = run.folder.config
    if kept.sensors is None or kept.prior is None:
        raise InputError(
            f"{run.folder.path}: config.toml has no sensors or no prior, which are needed to repeat the run"
        )
    config = RunConfig(run.folder.estimator, kept.settings, kept.sensors, kept.prior, kept.seed)
    stamps: list[float] = []
    poses: list[Array] = []

    def watch(t: float, estimator: Estimator) -> None:
        if stamps and t < stamps[-1] + INTERVAL - 1e-6:
            return
        belief = estimator.belief()
        stamps.append(t)
        if belief.particles is None or belief.weights is None:
            poses.append(np.empty((0, 3)))
        else:
            poses.append(belief.particles[_drawn(belief.weights)])

    again = run_log(log, config, progress, watch).causal()
    return Particles(np.array(stamps), tuple(poses), _difference(run.causal, again))


def _drawn(weights: Array) -> Array:
    """Indices (K,) of a systematic sample with ``weights`` (N,), K at most :data:`SHOWN`."""
    count = min(SHOWN, len(weights))
    shares = np.cumsum(weights / np.sum(weights))
    return np.searchsorted(shares, (np.arange(count) + 0.5) / count).clip(max=len(weights) - 1)


def _difference(stored: Trajectory, again: Trajectory | None) -> float:
    if again is None or len(again) != len(stored):
        return 0.0 if again is None and not len(stored) else float("inf")
    return float(np.hypot(*(stored.poses - again.poses)[:, :2].T).max(initial=0.0))
