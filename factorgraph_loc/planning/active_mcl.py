"""ActiveMCL, the paper's Algorithm 2, with one particle filter.

As printed, each action has particles of its own, weighted by a scan that was not made, and the index m is both the map and the
particle. Here one step is: propose paths; predict the reads along each, drawn from the antenna model, and the remaining entropy;
choose; move; and update the particles once, by the actual reads. The first three are in
:mod:`~factorgraph_loc.planning.policies`, the loop in :mod:`~factorgraph_loc.planning.closed_loop`, the particles here.

They start uniform over free space. The likelihood of a scan is applied in steps, with resampling from a kernel density in between
(progressive correction: Musso, Oudjane, Le Gland, in "Sequential Monte Carlo Methods in Practice", 2001, section 12.4). Their
number adapts to the size of the posterior (KLD sampling: Fox, IJRR 22(12), 2003, eq. 7). If tags are read that none of the
particles predicts, all are drawn anew (after sensor resetting: Lenser, Veloso, ICRA 2000, which replaces a fraction).
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree
from scipy.special import logsumexp

from factorgraph_loc.fusion import kld
from factorgraph_loc.fusion.cloud import Cloud, effective_size, largest_share, normalised, systematic, weighable
from factorgraph_loc.fusion.cloud_view import CloudView
from factorgraph_loc.fusion.timeline import Filter, FilterSettings, at_ticks
from factorgraph_loc.maps.free_space import CELL, FreeSpace
from factorgraph_loc.model.belief import Belief, PoseEstimate, PosePrior, Status
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.planning.robot import ProximitySensor
from factorgraph_loc.sensors.base import Link, NewVariable
from factorgraph_loc.sensors.binding import bound_sensors
from factors import se2
from factors.se2 import Array

RESAMPLE_BELOW, ENOUGH = (
    0.5,
    0.2,
)  # relative effective sample size: below which to resample; which one step of a correction leaves
OUTSIDE = -1.0  # log-weight per motion of a particle outside of free space
KERNEL, NEIGHBOURS = 0.5, 4  # kernel width relative to the distance of the n-th neighbour, and n
LEVER, WIDEST = 1.5, 0.7  # m: length equivalent of a radian; the widest kernel
LOST = math.log(1e-3)  # probability of the robot being anywhere else, at a scan that reads tags
ONE_PLACE, ONE_HEADING = 1.0, 0.8  # m, rad: largest standard deviations of a mode
MORE = 10  # factor on the number of particles while the pose is unknown


class ActiveMclSettings(FilterSettings):
    """``particles``: their number once localized; before there are up to :data:`MORE` times as many."""

    particles: Annotated[int, Field(ge=100, le=100_000)] = 2000


class _ActiveView(CloudView):
    """Shows sensors whether the particles agree on one place."""

    @property
    def localized(self) -> bool:
        return _is_one_place(self._filter._state)


class ActiveMcl(Filter):
    """The particle filter of ActiveMCL; see the module. ``space``: where the robot may be."""

    deterministic = False
    supports_unknown_start = True
    _state: Cloud
    _rng: np.random.Generator

    def __init__(self, setup: Setup, settings: ActiveMclSettings, space: FreeSpace) -> None:
        super().__init__(setup, settings)
        self._count, self._rng, self._space = settings.particles, setup.rng, space
        self._sensors = bound_sensors(setup, self._motion, self.diagnostics, calibration="none")

    def belief(self, t: float | None = None) -> Belief:
        """The particles with their weights, and their modes."""
        if self._state is None:
            return Belief(())
        cloud = self._at(t)._state
        return Belief(cloud.modes(), cloud.poses, cloud.weights)

    def trajectory(self) -> Trajectory:
        """The causal estimates."""
        poses = np.array([r.pose for r in self._records]).reshape(-1, 3)
        covariances = np.array([r.covariance for r in self._records]).reshape(-1, 3, 3)
        times = np.array([r.t for r in self._records])
        return at_ticks(self._ticks, times, poses, se2.world_to_body(poses, covariances))

    def _start(self, prior: PosePrior) -> Cloud:
        return _cloud(self._rng.multivariate_normal(prior.pose, prior.covariance, self._count))

    def _seek(self, m: Measurement) -> Cloud:
        """Draw particles uniformly over free space and all headings."""
        self._state = self._everywhere()
        if self._sensors[m.modality].finder is None:
            self._see(m)
        return self._state

    def _everywhere(self) -> Cloud:
        count = MORE * self._count
        cells = np.floor((np.arange(count) + self._rng.random()) * len(self._space.centres) / count)
        places = self._space.centres[cells.astype(np.int64)] + CELL * (self._rng.random((count, 2)) - 0.5)
        # a low-discrepancy sequence (golden ratio), so that neighbouring cells get different headings
        shares = (np.arange(count) * 0.5 * (math.sqrt(5.0) - 1.0)) % 1.0
        return _cloud(np.column_stack((places, math.pi * (2.0 * shares - 1.0))))

    def _predict(self, t: float) -> None:
        increment = self._travelled(t)
        noise = self._rng.standard_normal(self._state.poses.shape) @ np.linalg.cholesky(increment.covariance).T
        poses = se2.compose(se2.compose(self._state.poses, increment.delta), se2.exp(noise))
        outside = np.where(self._space.cells(poses[:, :2]) >= 0, 0.0, OUTSIDE)
        self._state = replace(self._state, poses=poses, log_weights=normalised(self._state.log_weights + outside))

    def _see(self, m: Measurement) -> None:
        sensor = self._sensors[m.modality]
        for seen in sensor.observe(m, _ActiveView(self)):
            if isinstance(seen, NewVariable | Link) or not seen.is_judged:  # strength and phase have many optima
                continue
            if seen.found and sensor.finder is None:
                # the reads are explained by none of the particles: the robot is lost
                anywhere = self._everywhere()
                told, else_told = (_evidence(c, seen.log_likelihood(c.poses, {})) for c in (self._state, anywhere))
                if told < else_told + LOST:
                    self._state = anywhere
                    sensor.restart(-math.inf)  # discard missed reads attributed to the old pose
            if _is_one_place(self._state):
                view = _ActiveView(self)
                correction = seen.correct(view.pose, view.covariance, {}, {}, 1)
                if not sensor.judge(seen, correction, view):
                    continue
            self._state = self._tempered(self._state, partial(seen.log_likelihood, values={}))

    def see(self, sensor: ProximitySensor, lengths: Array) -> None:
        """Weight the particles by free lengths (D,) [m] read by a proximity sensor; no effect before the first scan."""
        if self._state is not None:
            self._state = self._tempered(self._state, lambda poses: sensor.log_likelihood(poses, lengths))

    def _tempered(self, cloud: Cloud, log_likelihood: Callable[[Array], Array]) -> Cloud:
        """The cloud weighted by a likelihood, in steps."""
        left = 1.0
        while left > 0.0:
            found = weighable(log_likelihood(cloud.poses), cloud.log_weights, self._t)
            enough = ENOUGH * effective_size(cloud.log_weights)
            share = largest_share(cloud.log_weights, found, left, enough)
            cloud = replace(cloud, log_weights=normalised(cloud.log_weights + share * found))
            left -= share
            if effective_size(cloud.log_weights) < RESAMPLE_BELOW * len(cloud.poses):
                rows = systematic(cloud.weights, self._rng, MORE * self._count)
                rows = rows[kld.prefix(cloud.poses[rows], self._rng, self._count)]
                cloud = _cloud(_drawn(cloud.poses, rows, self._rng))
        return cloud

    def _estimate(self) -> PoseEstimate:
        status: Status = "localized" if _is_one_place(self._state) else "ambiguous"
        return PoseEstimate(self._t, *self._moments(), status)

    def _moments(self) -> tuple[Array, Array]:
        moments: tuple[Array, Array] = self._state.moments
        return moments

    def _record(self) -> PoseEstimate:
        return self._estimate()


def _drawn(poses: Array, rows: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """Particles (K, 3) drawn from kernels at the particles ``rows`` (K,) of ``poses`` (N, 3).

    The width of each kernel adapts to the distance of the neighbouring particles, so that the posterior stays covered where an
    informative scan leaves few particles.
    """
    different, which = np.unique(rows, return_inverse=True)
    kept = poses[different]
    places = np.column_stack((kept[:, :2], LEVER * np.cos(kept[:, 2]), LEVER * np.sin(kept[:, 2])))
    gaps, _ = cKDTree(places).query(places, k=[min(NEIGHBOURS + 1, len(places))])
    width = np.minimum(KERNEL * gaps[:, -1], WIDEST)[which]
    noise = rng.standard_normal((len(rows), 3)) * np.column_stack((width, width, width / LEVER))
    return se2.compose(poses[rows], se2.exp(noise))


def _evidence(cloud: Cloud, log_likelihood: Array) -> float:
    """Logarithm of a scan's mean likelihood over the particles."""
    return float(logsumexp(cloud.log_weights + log_likelihood))


def _cloud(poses: Array) -> Cloud:
    return Cloud(poses, np.zeros((len(poses), 0)), np.full(len(poses), -math.log(len(poses))), localized=False)


def _is_one_place(cloud: Cloud) -> bool:
    covariance = cloud.moments[1]
    return bool(np.linalg.eigvalsh(covariance[:2, :2])[-1] < ONE_PLACE**2 and covariance[2, 2] < ONE_HEADING**2)
