"""Particle filter with systematic resampling, and backward simulation for its final trajectory.

Sequential importance resampling (Gordon, Salmond, Smith, 1993) on log-weights; resampling when the effective sample size falls
below a share of the particles. Constants of the odometry that are estimated travel with each particle and are
rejuvenated by the kernel of Liu and West (2001). The final trajectory is the mean of trajectories drawn backwards
(Godsill, Doucet, West, JASA 99(465), 2004) through the clouds that are kept every ``smoothing_interval``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.estimators.ancestors import draw_ancestors
from factorgraph_loc.estimators.base import Belief, Learnt, Mode, PoseEstimate, PosePrior
from factorgraph_loc.estimators.filtering import Filter, FilterSettings
from factorgraph_loc.estimators.landmarks import KnownLandmarks, robust_update
from factorgraph_loc.estimators.registry import Setup
from factorgraph_loc.measurements import BearingRange
from factorgraph_loc.trajectory import Trajectory
from factors import se2
from factors.bearing_range import log_likelihood
from factors.odometry import PARAMETERS, ChainState, Increment, recalibrated
from factors.se2 import Array

KERNEL = 0.1  # Liu and West's h: the share of a constant's spread that is drawn anew when resampling


class ParticleFilterSettings(FilterSettings):
    """``particles``: their number. ``resample_below``: effective sample size, as a share, below which they are resampled.
    ``smoothing_trajectories``: drawn backwards for the final result, through clouds ``smoothing_interval`` seconds apart."""

    particles: Annotated[int, Field(ge=10, le=1_000_000)] = 5000
    resample_below: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    smoothing_trajectories: Annotated[int, Field(ge=10, le=10_000)] = 100
    smoothing_interval: Annotated[float, Field(ge=0.1, le=60.0)] = 1.0


@dataclass(frozen=True)
class _Cloud:
    """``poses`` (N, 3), ``parameters`` (N, P) and normalised ``log_weights`` (N,)."""

    poses: Array
    parameters: Array
    log_weights: Array


@dataclass(frozen=True)
class _Record:
    """A stamp of the run: the odometry there, the causal estimate, and the cloud where it is kept for smoothing."""

    t: float
    odometry: ChainState
    mean: Array
    covariance: Array
    cloud: _Cloud | None


class ParticleFilter(Filter):
    """The particle filter; see the module."""

    deterministic = False
    _state: _Cloud

    def __init__(self, setup: Setup, settings: ParticleFilterSettings) -> None:
        super().__init__(setup, settings)
        self._settings = settings
        self._rng = setup.rng
        self._landmarks = KnownLandmarks(setup, self.diagnostics)
        self._estimated = setup.rig.estimated_odometry()

    def belief(self) -> Belief:
        """The particles with their weights, and the Gaussian with their moments."""
        e = self.estimate()
        return Belief((Mode(1.0, e.pose, e.covariance),), self._state.poses, np.exp(self._state.log_weights))

    def learnt(self) -> Learnt:
        """The odometry's constants that are estimated."""
        if self._state is None:
            return Learnt()
        mean, covariance = _vector_moments(self._state.parameters, np.exp(self._state.log_weights))
        sigmas = np.sqrt(np.diag(covariance))
        return Learnt({n: (float(v), float(s)) for n, v, s in zip(self._estimated.names, mean, sigmas, strict=True)})

    def trajectory(self) -> Trajectory:
        """Mean and covariance of trajectories drawn backwards, or the causal estimates with ``smooth`` off."""
        last = {r.t: i for i, r in enumerate(self._records)}
        rows = [last[t] for t in sorted(set(self._ticks))]
        t = np.array([self._records[i].t for i in rows])
        if not self._smooth:
            means = np.array([self._records[i].mean for i in rows])
            return Trajectory(t, means, np.array([self._records[i].covariance for i in rows]))
        kept = [i for i, r in enumerate(self._records) if r.cloud is not None]
        if kept[-1] != len(self._records) - 1:
            kept.append(len(self._records) - 1)
            self._records[-1] = replace(self._records[-1], cloud=self._state)
        drawn = self._draw_backwards(kept)
        poses, covariances = np.empty((len(rows), 3)), np.empty((len(rows), 3, 3))
        before = np.searchsorted(kept, rows, side="right") - 1
        for n, (row, k) in enumerate(zip(rows, before, strict=True)):
            poses[n], covariances[n] = self._bridge(drawn, kept, int(k), self._records[row])
        return Trajectory(t, poses, covariances)

    def _start(self, prior: PosePrior) -> _Cloud:
        count = self._settings.particles
        poses = self._rng.multivariate_normal(prior.pose, prior.covariance, count)
        poses[:, 2] = se2.wrap(poses[:, 2])
        parameters = self._rng.standard_normal((count, len(self._estimated.indices))) * self._estimated.sigmas
        return _Cloud(poses, parameters, np.full(count, -np.log(count)))

    def _predict(self, increment: Increment) -> None:
        cloud = self._state
        noise = self._rng.standard_normal(cloud.poses.shape) @ np.linalg.cholesky(increment.covariance).T
        self._state = replace(cloud, poses=se2.compose(self._moved(cloud, increment), se2.exp(noise)))

    def _moved(self, cloud: _Cloud, increment: Increment) -> Array:
        """Poses (N, 3) after the increment, each under its own constants, without noise."""
        if not cloud.parameters.shape[1]:
            return se2.compose(cloud.poses, increment.delta)
        return se2.compose(
            cloud.poses, recalibrated(increment, self._estimated.full(cloud.parameters, len(PARAMETERS)))[0]
        )

    def _update(self, m: BearingRange) -> None:
        seen = self._landmarks.factor(m)
        if seen is None:
            return
        mean, covariance = pose_moments(self._state.poses, np.exp(self._state.log_weights))
        update = robust_update(seen, mean, se2.world_to_body(mean, covariance), iterations=1)
        self._landmarks.report(m.t, seen, update)
        log_weights = self._state.log_weights + log_likelihood(
            seen.model, self._state.poses, seen.points, seen.ranges, seen.bearings
        )
        log_weights -= log_weights.max()
        log_weights -= np.log(np.sum(np.exp(log_weights)))
        self._state = replace(self._state, log_weights=log_weights)
        effective = 1.0 / np.sum(np.exp(2.0 * log_weights))
        if effective < self._settings.resample_below * len(log_weights):
            self._resample()

    def _resample(self) -> None:
        cloud = self._state
        chosen = systematic(np.exp(cloud.log_weights), self._rng)
        parameters = cloud.parameters[chosen]
        if parameters.shape[1]:
            mean, spread = parameters.mean(axis=0), parameters.std(axis=0)
            shrunk = mean + np.sqrt(1.0 - KERNEL**2) * (parameters - mean)
            parameters = shrunk + KERNEL * spread * self._rng.standard_normal(parameters.shape)
        count = len(chosen)
        self._state = _Cloud(cloud.poses[chosen], parameters, np.full(count, -np.log(count)))

    def _estimate(self) -> PoseEstimate:
        mean, covariance = pose_moments(self._state.poses, np.exp(self._state.log_weights))
        return PoseEstimate(self._t, mean, covariance, "localized")

    def _record(self) -> _Record:
        estimate = self._estimate()
        last = next((r.t for r in reversed(self._records) if r.cloud is not None), -np.inf)
        keep = self._smooth and self._t >= last + self._settings.smoothing_interval - 1e-9
        return _Record(self._t, self._odometry, estimate.pose, estimate.covariance, self._state if keep else None)

    def _increment(self, start: _Record, end: _Record) -> Increment:
        return self._motion.relative(start.odometry, end.odometry)

    def _draw_backwards(self, kept: list[int]) -> Array:
        """Trajectories (K, M, 3) through the kept clouds, drawn from the last to the first."""
        count = self._settings.smoothing_trajectories
        clouds = [self._cloud(i) for i in kept]
        out = np.empty((len(kept), count, 3))
        chosen = systematic(np.exp(clouds[-1].log_weights), self._rng, count)
        out[-1] = clouds[-1].poses[chosen]
        for k in range(len(kept) - 2, -1, -1):
            increment = self._increment(self._records[kept[k]], self._records[kept[k + 1]])
            predicted = self._moved(clouds[k], increment)
            uniform = self._rng.random(count)
            rows = draw_ancestors(predicted, clouds[k].log_weights, out[k + 1], increment.covariance, uniform)
            out[k] = clouds[k].poses[rows]
        return out

    def _cloud(self, record: int) -> _Cloud:
        cloud: _Cloud | None = self._records[record].cloud
        assert cloud is not None
        return cloud

    def _bridge(self, drawn: Array, kept: list[int], k: int, at: _Record) -> tuple[Array, Array]:
        """Moments of the drawn trajectories at a stamp between the kept clouds ``k`` and ``k + 1``."""
        start = self._records[kept[k]]
        since = self._increment(start, at)
        poses = se2.compose(drawn[k], since.delta)
        extra = np.zeros((3, 3))
        if k + 1 < len(kept) and since.duration > 0.0:
            whole = self._increment(start, self._records[kept[k + 1]])
            share = since.duration / whole.duration
            missed = se2.log(se2.between(se2.compose(drawn[k], whole.delta), drawn[k + 1]))
            poses = se2.compose(poses, se2.exp(share * missed))
            extra = share * (1.0 - share) * whole.covariance
        mean, covariance = pose_moments(poses, np.full(len(poses), 1.0 / len(poses)))
        return mean, covariance + se2.body_to_world(mean, extra)


def systematic(weights: Array, rng: np.random.Generator, count: int | None = None) -> Array:
    """Indices of ``count`` draws (as many as weights by default) by systematic resampling (Kitagawa, 1996)."""
    count = len(weights) if count is None else count
    positions = (rng.random() + np.arange(count)) / count
    cumulative = np.cumsum(weights)
    return np.minimum(np.searchsorted(cumulative / cumulative[-1], positions), len(weights) - 1)


def pose_moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean (3,), circular in heading, and covariance (3, 3) of poses (N, 3) in the world's frame."""
    heading = np.arctan2(weights @ np.sin(poses[:, 2]), weights @ np.cos(poses[:, 2]))
    mean = np.array((weights @ poses[:, 0], weights @ poses[:, 1], heading))
    error = poses - mean
    error[:, 2] = se2.wrap(error[:, 2])
    covariance = (weights[:, None] * error).T @ error
    return mean, covariance + np.diag(np.full(3, MINIMUM_VARIANCE))


def _vector_moments(values: Array, weights: Array) -> tuple[Array, Array]:
    mean = weights @ values
    error = values - mean
    return mean, (weights[:, None] * error).T @ error


# of a cloud that has collapsed to one point: its covariance must still be one
MINIMUM_VARIANCE = 1e-10
