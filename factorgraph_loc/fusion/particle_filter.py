"""Particle filter with systematic resampling, and backward simulation for its final trajectory.

The filter is sequential importance resampling (Gordon, Salmond, Smith, 1993) with log-weights. It resamples when the
effective sample size falls below a fraction of the number of particles. It draws new particles from a kernel density
instead of copying particles (regularised particle filter: Musso, Oudjane, Le Gland, in "Sequential Monte Carlo Methods
in Practice", 2001, chapter 12). The particles therefore stay distinct when the motion adds almost no noise. Each
particle has its own estimated constants of odometry and sensors. Resampling moves their mean at random, so their
reported covariance is slightly too small if landmarks hardly inform them.

Particles move by odometry at each observation, and when a cloud (all particles at one time) is stored for smoothing.
Between these times the estimate is the Gaussian of poses and constants, predicted as in the EKF.

At an unknown start, and after the track is rejected, particles are drawn from the posterior of the search
(:mod:`~factorgraph_loc.fusion.search`). A start with an unknown heading is an unknown start.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.files.models import InUnit
from factorgraph_loc.fusion import kld
from factorgraph_loc.fusion.cloud import (
    Cloud,
    Corrected,
    corrected,
    finished,
    in_one_step,
    systematic,
    vector_moments,
)
from factorgraph_loc.fusion.filter import Filter, FilterSettings, FilterView, twin
from factorgraph_loc.fusion.layout import POSE, Layout, constants_of, learnt_from, on_pose
from factorgraph_loc.fusion.particle_smoothing import BackwardSimulation, Record
from factorgraph_loc.fusion.timeline import Taken
from factorgraph_loc.fusion.tracking import LOST, Change, Tracking, is_known
from factorgraph_loc.model.belief import Belief, Learnt, Mode, PoseEstimate, PosePrior, Status
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement, Tick
from factorgraph_loc.model.setup import Calibration, Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.base import Binding, Link, NewVariable, Observation
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.motion import MOTION
from factorgraph_loc.sensors.registry import bound_sensors
from factors import positive, se2
from factors.motion import Increment
from factors.se2 import Array

# If the computing cost of weighing all particles exceeds HEAVY (in the unit of `Observation.work`), only FEW are weighed first.
FEW, HEAVY = 500, 2_000_000


class ParticleFilterSettings(FilterSettings):
    """Settings of the particle filter. With ``kld``, KLD sampling chooses the number of particles (Fox, IJRR 22(12), 2003)."""

    particles: Annotated[int, Field(ge=10, le=1_000_000)] = 5000
    """number of particles; with kld the maximum number"""
    kld: bool = False
    """whether the number of particles is adapted to the spread of the poses (KLD sampling)"""
    min_particles: Annotated[int, Field(ge=10, le=1_000_000)] = 500
    """minimum number of particles with kld"""
    resample_below: Annotated[float, Field(ge=1e-6, le=1.0)] = 0.5
    """effective sample size, as a fraction of the number of particles, below which they are resampled"""
    smoothing_trajectories: Annotated[int, Field(ge=10, le=10_000)] = 100
    """number of trajectories that are drawn backwards for the final result"""
    smoothing_interval: Annotated[float, Field(ge=0.1, le=60.0), InUnit("s")] = 1.0
    """time between the stored particle sets that trajectories of the final result pass through"""
    self_calibration: bool = True
    """whether each particle estimates the sensor constants that have an uncertainty in the rig, except the time offset
    of landmarks and the constants of a camera; the uncertainty of camera constants increases the noise of pixels"""


class _CloudView(FilterView):
    """Gives sensors read access to the current estimates and covariances of the particle filter."""

    _filter: ParticleFilter

    @property
    def localized(self) -> bool:
        return self._filter._state.localized

    @property
    def pose(self) -> Array:
        return self._filter._moments()[0]

    @property
    def covariance(self) -> Array:
        return se2.world_to_body(*self._filter._moments())

    def value(self, name: str) -> Array | None:
        cloud = self._filter._state
        part = cloud.parts.get(name)
        return None if part is None else np.asarray(cloud.weights @ cloud.constants[:, part])

    def block_covariance(self, name: str) -> Array:
        cloud = self._filter._state
        return vector_moments(cloud.constants[:, cloud.parts[name]], cloud.weights)[1]

    def joint(self) -> tuple[Array, Mapping[str, slice]]:
        return self.covariance, {}


class ParticleFilter(Filter):
    """Monte-Carlo localization. It resamples from a kernel density and smooths by backward simulation."""

    deterministic = False
    supports_unknown_start = True
    _state: Cloud

    def __init__(self, setup: Setup, settings: ParticleFilterSettings, diagnostics: Diagnostics | None = None) -> None:
        super().__init__(setup, settings, diagnostics)
        self._settings = settings
        self._drawn_by = setup.rng
        # a separate generator, which is copied before use, so that each request draws the same trajectories
        (self._smoothing_rng,) = setup.rng.spawn(1)
        calibration: Calibration = "particles" if settings.self_calibration else "none"
        self._sensors = bound_sensors(Binding(setup, self._motion, self.diagnostics, calibration=calibration))
        self._constants = constants_of(self._motion, self._sensors)
        columns = Layout.of(self._constants).columns
        # the columns of each block in the constants of the particles
        self._parts = {name: slice(part.start - POSE, part.stop - POSE) for name, part in columns.items()}
        self._search = Tracking(self._sensors, self._motion, setup.rng, self.diagnostics)
        self._search.remember()
        self._lost = False
        # times [s] of rejections of the estimated pose, each with the interval when the robot was carried
        self._changes: list[tuple[float, Change]] = []

    def belief(self, t: float | None = None) -> Belief:
        """Return the weighted particles and the Gaussians of their modes (one Gaussian if the robot is localized)."""
        if self._state is None:
            return Belief(())
        predicted = self._at(t)
        cloud = predicted._moved_on(twin(self._drawn_by))
        modes = (Mode(1.0, *predicted._moments()),) if cloud.localized else cloud.modes()
        return Belief(modes, cloud.poses, cloud.weights)

    def learnt(self) -> Learnt:
        """Return the estimated sensor constants with standard deviations. The result has no landmarks."""
        if self._state is None:
            return Learnt()
        cloud = self._state
        moments = {n: vector_moments(cloud.constants[:, part], cloud.weights) for n, part in cloud.parts.items()}
        return learnt_from(self._constants, ((name, *parts) for name, parts in moments.items()))

    def trajectory(self) -> Trajectory:
        """Return the trajectory smoothed by backward simulation, or the estimates during the run if ``smooth`` is
        off."""
        last = {r.t: r for r in self._records}
        records = [last[t] for t in sorted(set(self._ticks))]
        if not self._smooth or not records:
            moments = [(r.mean, r.covariance) for r in records]
        else:
            kept = [r for r in self._records if r.cloud is not None]
            records = [r for r in records if r.t >= kept[0].t]
            if kept[-1] is not self._records[-1]:
                kept.append(replace(self._records[-1], cloud=self._moved_on(twin(self._smoothing_rng))))
            changes = [change for _, change in self._changes]
            known = is_known(np.array([r.t for r in records]), changes)
            records = [r for r, is_reported in zip(records, known.tolist(), strict=True) if is_reported]
            rng = twin(self._smoothing_rng)
            simulation = BackwardSimulation(
                kept, self._increment, self._moved, rng, self._settings.smoothing_trajectories, changes
            )
            moments = [simulation.at(r) for r in records]
        poses = np.array([pose for pose, _ in moments]).reshape(-1, 3)
        return Trajectory(np.array([r.t for r in records]), poses, np.array([c for _, c in moments]).reshape(-1, 3, 3))

    def forget(self, until: float) -> None:
        """Delete the trajectory before ``until`` [s], except the last particles before it, which smoothing needs."""
        clouds = [r.t for r in self._records if r.cloud is not None and r.t <= until]
        super().forget(max(clouds, default=-math.inf) if self._smooth else until)

    def _start(self, prior: PosePrior) -> Cloud:
        if prior.has_heading:
            self._search.begin_track(by_search=False)
            return self._cloud(
                self._drawn_by.multivariate_normal(prior.pose, prior.covariance, self._settings.particles)
            )
        start = KnownPosition(prior, self._motion)
        self._search.begin(start)
        poses = start.drawn(self._drawn_by, self._settings.particles, self._odometry)
        return replace(self._cloud(poses), localized=False)

    def _take(self, m: Measurement) -> None:
        if self._search.start is not None:
            self._search.start.settle()
        super()._take(m)

    def _begin(self, m: Measurement) -> None:
        super()._begin(m)
        if isinstance(m, Tick) and self._search.advance(m.t):
            self._t, self._odometry, self._moves = m.t, self._motion.state(m.t), True
            cloud = self._sampled_cloud(m.t)
            if cloud is not None:
                self._state, self._begun = cloud, m.t
                self._records.append(self._record())

    def _seek(self, m: Measurement) -> Cloud | None:
        return self._sampled_cloud(self._t) if self._search.look(m, self._odometry) else None

    def _sampled_cloud(self, since: float) -> Cloud | None:
        """Return particles drawn from the result of the global search, or None if there is no result yet.

        If the search has found one clear pose, the filter is localized, and sensors restart at the time ``since`` [s].
        The sensor constants are from the last localized particles before ``since``, or from the prior if there are
        none.
        """
        clouds = (r.cloud for r in reversed(self._records) if r.cloud is not None and r.t < since)
        previous = next((cloud for cloud in clouds if cloud.localized), None)
        sample = self._search.sample(self._drawn_by, self._settings.particles, self._odometry)
        if sample is None:
            return None
        cloud = replace(self._cloud(sample[0], previous), odometry=sample[1], localized=self._search.best is not None)
        if cloud.localized:
            self._search.begin_track(by_search=True)
            for sensor in self._sensors.values():
                sensor.restart(since)
            kind = "recovered" if self._lost else "localized"
            self.diagnostics.event(self._t, kind, kind)
        return cloud

    def _cloud(self, poses: Array, previous: Cloud | None = None) -> Cloud:
        """Return particles of equal weight at ``poses`` (N, 3), with constants drawn from ``previous`` or the prior."""
        count = len(poses)
        poses[:, 2] = se2.wrap(poses[:, 2])
        log_weights = np.full(count, -np.log(count))
        if previous is not None:
            rows = self._drawn_by.permutation(systematic(previous.weights, self._drawn_by, count))
            return replace(previous, poses=poses, constants=previous.constants[rows], log_weights=log_weights)
        sigmas = np.concatenate([constants.sigmas for constants in self._constants.values()])
        constants = self._drawn_by.standard_normal((count, len(sigmas))) * sigmas
        return Cloud(poses, constants, log_weights, parts=self._parts, odometry=self._odometry)

    def _anchor(self) -> None:
        super()._anchor()
        if self._state.odometry.t == self._t and self._state.odometry != self._odometry:
            self._state = replace(self._state, odometry=self._odometry)

    def _predict(self, t: float) -> None:
        self._odometry, _ = self._motion.travelled(self._odometry, t)

    def _moved_on(self, rng: np.random.Generator) -> Cloud:
        """Return the particles moved by odometry, with noise drawn from ``rng``, to the time of the filter."""
        cloud = self._state
        if cloud.odometry.t == self._t:
            return cloud
        increment = self._motion.relative(cloud.odometry, self._odometry)
        noise = rng.standard_normal((len(cloud.poses), 3)) @ positive.root(increment.covariance).T
        poses, _ = self._moved(cloud, increment, noise)
        return replace(cloud, poses=poses, odometry=self._odometry)

    def _moments(self) -> tuple[Array, Array]:
        """Return mean (3,) and covariance (3, 3) of the current pose in the world frame."""
        cloud = self._state
        if cloud.odometry.t == self._t:
            return cloud.moments
        mean, covariance = cloud.joint
        part = cloud.parts.get(MOTION, slice(0, 0))
        _, poses, _, _, _, worlds = self._motion.predictions(
            cloud.odometry, (self._t,), cloud.moments[0], covariance, mean[part], POSE + part.start
        )
        return poses[0], worlds[0]

    def _moved(self, cloud: Cloud, increment: Increment, noise: Array | None = None) -> tuple[Array, Array]:
        """Return the poses (N, 3) of ``cloud`` moved by odometry, with each particle's constants and with body-frame
        ``noise``. Also returns the Jacobian (3, 3+P) of the new pose by body-frame perturbation and constants."""
        by_constants = np.zeros((3, cloud.constants.shape[1]))
        delta = increment.delta
        part = cloud.parts.get(MOTION)
        if part is not None:
            values = cloud.constants[:, part]
            mean = cloud.weights @ values
            delta, by_constants[:, part] = self._motion.changed(increment, mean)
            changed = (values - mean) @ by_constants[:, part].T
            noise = changed if noise is None else noise + changed
        poses = se2.compose(cloud.poses, delta) if noise is None else se2.all_moved(cloud.poses, delta, noise)
        return poses, np.concatenate((se2.adjoint(se2.inverse(delta)), by_constants), axis=1)

    def _see(self, m: Measurement) -> None:
        self._state = self._moved_on(self._drawn_by)
        if not self._state.localized:
            if self._search.look(m, self._odometry):
                self._state = self._sampled_cloud(self._t) or self._state
            return
        sensor, view = self._sensors[m.source], _CloudView(self)
        for observation in sensor.observe(m, view):
            if isinstance(observation, NewVariable) and not observation.sightings:
                new = observation
                self._state = self._state.with_block(new.name, new.mean, new.noise, self._drawn_by)
            if isinstance(observation, Link | NewVariable):
                continue
            alone = observation
            if observation.is_judged:
                alone = on_pose(observation, view)
                correction = alone.correct(view.pose, view.covariance, {}, {}, 1)
                if not sensor.judge(alone, correction, view):
                    continue
                self._search.slips.add(alone.at_its_time, self._odometry, view, correction)
                self._search.expect(sensor, alone, self._odometry, view)
            evidence = self._weigh(observation)
            self._search.keep(sensor, alone, self._odometry, partial(float, evidence))
        self._doubt(m)

    def _pass(self, tick: Tick) -> None:
        if self._state.localized:
            if self._t >= self._state.odometry.t + self._settings.smoothing_interval - 1e-9:
                self._state = self._moved_on(self._drawn_by)
            self._doubt(tick)
            return
        self._state = self._moved_on(self._drawn_by)
        if self._search.advance(tick.t):
            self._state = self._sampled_cloud(self._t) or self._state

    def _doubt(self, m: Measurement) -> None:
        """Check whether observations contradict the particles. If they do, draw new ones from a global search."""
        view = _CloudView(self)
        refuted = self._search.refuted(m, view.track, view.pose_back)
        if refuted is not None:
            # mark the records since the estimated pose became wrong, so that smoothing does not continue from them
            self._records = [r.lost() if r.t >= refuted.since else r for r in self._records]
            self.diagnostics.event(self._t, "lost", LOST, why=refuted.why, since=refuted.since)
            self._lost = True
            self._changes.append((self._t, refuted.change))
            self._state = self._sampled_cloud(refuted.since) or self._state

    def _go_back(self, taken: Taken) -> None:
        super()._go_back(taken)
        self._changes = [(rejected, change) for rejected, change in self._changes if rejected <= self._t]

    def _weigh(self, observation: Observation) -> float:
        """Weigh the particles by an observation, and return the logarithm of the mean likelihood. If the observation is
        costly, a few particles are corrected first, by a part of the likelihood. Then all particles are drawn from
        these, and corrected by the rest."""
        cloud, count, enough = self._state, self._settings.particles, self._settings.resample_below

        @in_one_step
        def likelihood(cloud: Cloud) -> Array:
            values = {name: cloud.constants[:, cloud.parts[name]] for name in observation.blocks}
            return observation.log_likelihood(cloud.poses, values)

        def correct(cloud: Cloud, count: int, enough: float, left: float, *, to_end: bool = True) -> Corrected:
            resampled = in_one_step(lambda cloud: self._resampled(cloud, count))
            steps = corrected(
                cloud, likelihood, resampled, lambda c: enough * len(c.poses), self._t, left=left, to_end=to_end
            )
            return finished(steps)

        evidence, left = 0.0, 1.0
        if count > FEW and observation.work * count > HEAVY:
            # while sensors contradict the pose, a few particles are enough, because the search may soon replace all
            doubted = self._search.doubts
            few, evidence, left = correct(cloud.thinned(FEW), FEW, enough, left, to_end=doubted)
            if doubted:
                self._state = few
                return evidence
            cloud = self._resampled(few, count) if left < 1.0 else cloud
            enough *= 0.5
        self._state, more, _ = correct(cloud, count, enough, left)
        return evidence + more

    def _resampled(self, cloud: Cloud, count: int) -> Cloud:
        chosen = systematic(cloud.weights, self._drawn_by, count)
        if self._settings.kld:
            chosen = chosen[kld.prefix(cloud.poses[chosen], self._drawn_by, self._settings.min_particles)]
        density, kernel = cloud.density()
        return density.drawn(chosen, kernel, self._drawn_by)

    def _estimate(self) -> PoseEstimate:
        if self._state.localized:
            pose, covariance = self._moments()
            doubted = self._search.doubts or self._search.is_unsure(self._t, covariance)
            status: Status = "ambiguous" if doubted else "localized"
            return PoseEstimate(self._t, pose, covariance, status)
        mode = self._moved_on(twin(self._drawn_by)).modes()[0]
        return PoseEstimate(self._t, mode.pose, mode.covariance, "ambiguous")

    def _record(self) -> Record:
        estimate = self._estimate()
        keep = self._smooth and self._is_due()
        if keep:
            self._state = self._moved_on(self._drawn_by)
        return Record(self._t, self._odometry, estimate.pose, estimate.covariance, self._state if keep else None)

    def _is_due(self) -> bool:
        """Return True if smoothing needs the current particles: its interval is over, or the pose has just jumped."""
        if self.diagnostics.events and self.diagnostics.events[-1].t == self._t:
            return True
        last = next((r.t for r in reversed(self._records) if r.cloud is not None), -math.inf)
        return self._t >= last + self._settings.smoothing_interval - 1e-9

    def _increment(self, start: Record, end: Record) -> Increment:
        return self._motion.relative(start.odometry, end.odometry)
