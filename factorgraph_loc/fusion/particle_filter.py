"""Particle filter with systematic resampling, and backward simulation for its final trajectory.

Sequential importance resampling (Gordon, Salmond, Smith, 1993) on log-weights; resampling when the effective sample size falls
below a share of the particles, from their density instead of the particles themselves (regularised particle filter: Musso,
Oudjane, Le Gland, in "Sequential Monte Carlo Methods in Practice", 2001, chapter 12), so that they do not deplete where the motion
adds next to no noise. Constants of odometry and sensor that are estimated travel with each particle. Their stated spread is a
little too small where landmarks tell next to nothing of them: resampling moves their mean at random.

Where the place is not known, at an unknown start or once it is refuted, particles are drawn from what landmarks tell of it
(:mod:`~factorgraph_loc.fusion.landmark_tracker`), or where no landmarks are used from what scans of RFID tags tell
(:mod:`~factorgraph_loc.sensors.rfid.tracker`). A camera tells it by itself (:mod:`~factorgraph_loc.sensors.camera.tracker`).
A start with an unknown heading is such a place: particles there face anywhere.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.fusion import kld
from factorgraph_loc.fusion.cloud import Cloud, largest_share, normalised, systematic, vector_moments, weighable
from factorgraph_loc.fusion.known_position import KnownPosition
from factorgraph_loc.fusion.landmark_tracker import LandmarkTracker
from factorgraph_loc.fusion.particle_smoothing import BackwardSimulation, Record
from factorgraph_loc.fusion.timeline import Filter, FilterSettings
from factorgraph_loc.model.belief import Belief, Mode, PoseEstimate, PosePrior, Status
from factorgraph_loc.model.learnt import Learnt
from factorgraph_loc.model.measurement import Exteroceptive, Tick
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.variable import NOTHING, Estimated
from factorgraph_loc.sensors.camera.finder import MISSED
from factorgraph_loc.sensors.camera.sensor import Pixels
from factorgraph_loc.sensors.camera.tracker import PixelTracker
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factorgraph_loc.sensors.rfid.monitor import Silence
from factorgraph_loc.sensors.rfid.tracker import ScanTracker
from factors import positive, se2
from factors.landmarks import model as bearing_range
from factors.landmarks.model import TIME_OFFSET
from factors.motion import Increment
from factors.odometry import model as odometry
from factors.odometry.model import recalibrated
from factors.se2 import Array


class ParticleFilterSettings(FilterSettings):
    """``particles``: their number; with ``kld`` the largest, of which no more are resampled than their spread needs, but at least
    ``min_particles`` (KLD sampling: Fox, IJRR 22(12), 2003). ``resample_below``: effective sample size, as a share, below which
    they are resampled. ``smoothing_trajectories``: drawn backwards for the final result, through clouds
    ``smoothing_interval`` seconds apart. ``self_calibration``: constants to which the rig gives an uncertainty travel with
    each particle, but not the sensor's time offset, which is taken as the rig has it, and not those of the camera, which widen
    the noise of its pixels instead."""

    particles: Annotated[int, Field(ge=10, le=1_000_000)] = 5000
    kld: bool = False
    min_particles: Annotated[int, Field(ge=10, le=1_000_000)] = 500
    resample_below: Annotated[float, Field(ge=1e-6, le=1.0)] = 0.5
    smoothing_trajectories: Annotated[int, Field(ge=10, le=10_000)] = 100
    smoothing_interval: Annotated[float, Field(ge=0.1, le=60.0)] = 1.0
    self_calibration: bool = True


class ParticleFilter(Filter):
    """The particle filter; see the module."""

    deterministic = False
    supports_unknown_start = True
    modalities = frozenset({"bearing_range", "rfid", "camera"})
    _state: Cloud
    _rng: np.random.Generator

    def __init__(self, setup: Setup, settings: ParticleFilterSettings) -> None:
        super().__init__(setup, settings)
        self._settings = settings
        self._rng = setup.rng
        # trajectories are drawn by a generator of their own, whose state is kept: the same ones each time
        (self._smoothing_rng,) = setup.rng.spawn(1)
        self._odometry_constants = self._sensor_constants = NOTHING
        sensor = setup.rig.bearing_range
        if settings.self_calibration:
            self._odometry_constants = setup.rig.estimated("odometry")
            self._sensor_constants = Estimated.of(bearing_range.PARAMETERS[:TIME_OFFSET], sensor and sensor.uncertainty)
        middle = len(self._odometry_constants.names)
        self._odometry_part = slice(0, middle)  # where they lie in the constants of the particles
        self._landmarks = LandmarkTracker(setup, self._motion, self.diagnostics, self._sensor_constants, first=middle)
        self._scans = ScanTracker(setup, self._motion, self.diagnostics, finds=not self._landmarks.known)
        self._pixels = PixelTracker(setup, self._motion, self.diagnostics)
        self._lost = False
        self._from: KnownPosition | None = None

    def belief(self, t: float | None = None) -> Belief:
        """The particles with their weights, and the Gaussians of their modes; of all, once the place is known."""
        if self._state is None:
            return Belief(())
        cloud = self._at(t)._state
        modes = (Mode(1.0, *cloud.moments),) if cloud.localized else cloud.modes()
        return Belief(modes, cloud.poses, cloud.weights)

    def learnt(self) -> Learnt:
        """The constants that are estimated."""
        if self._state is None:
            return Learnt()
        mean, covariance = vector_moments(self._state.constants, self._state.weights)
        sigmas = np.sqrt(np.diag(covariance))
        names = [*self._odometry_constants.names, *(f"bearing_range.{name}" for name in self._sensor_constants.names)]
        return Learnt({n: (float(v), float(s)) for n, v, s in zip(names, mean, sigmas, strict=True)})

    def trajectory(self) -> Trajectory:
        """Mean and covariance of trajectories drawn backwards, or the causal estimates with ``smooth`` off."""
        last = {r.t: r for r in self._records}
        records = [last[t] for t in sorted(set(self._ticks))]
        if not self._smooth or not records:
            found = [(r.mean, r.covariance) for r in records]
        else:
            kept = [r for r in self._records if r.cloud is not None]
            records = [r for r in records if r.t >= kept[0].t]
            if kept[-1] is not self._records[-1]:
                kept.append(replace(self._records[-1], cloud=self._state))
            rng = copy.deepcopy(self._smoothing_rng)
            simulation = BackwardSimulation(
                kept, self._increment, self._moved, rng, self._settings.smoothing_trajectories
            )
            found = [simulation.at(r) for r in records]
        poses = np.array([pose for pose, _ in found]).reshape(-1, 3)
        return Trajectory(np.array([r.t for r in records]), poses, np.array([c for _, c in found]).reshape(-1, 3, 3))

    def forget(self, before: float) -> None:
        """Forget the trajectory before then, from the last cloud back that is kept for smoothing."""
        clouds = [r.t for r in self._records if r.cloud is not None and r.t <= before]
        super().forget(max(clouds, default=-math.inf) if self._smooth else before)

    def _start(self, prior: PosePrior) -> Cloud:
        if not prior.has_heading:
            start = KnownPosition(prior, self._motion)
            self._seek_from(start)
            poses = start.drawn(self._rng, self._settings.particles, self._odometry)
            return replace(self._cloud(poses), localized=False)
        self._scans.start(found=False)
        return self._cloud(self._rng.multivariate_normal(prior.pose, prior.covariance, self._settings.particles))

    def _take(self, m: Exteroceptive | Tick) -> None:
        if self._from is not None:
            self._from.settle()
        super()._take(m)

    def _seek_from(self, start: KnownPosition | None) -> None:
        """Tell the searches what is known of the start, as long as its heading is sought."""
        self._from = start
        for part in (self._landmarks, self._scans, self._pixels):
            part.seek_from(start)

    def _seek(self, m: Exteroceptive) -> Cloud | None:
        if isinstance(m, RfidScan):
            return self._sought() if self._scans.seek(m, self._odometry) else None
        if isinstance(m, Pixels):
            if not self._pixels.seek(m, self._odometry):
                return None
            poses, clear = self._pixels.sought(self._settings.particles)
            return replace(self._cloud(poses), localized=clear)
        seen = self._landmarks.factor(m)
        if seen is None:
            return None
        self._landmarks.seek(seen, self._odometry)
        return replace(self._cloud(self._landmarks.sample(self._settings.particles)), localized=False)

    def _sought(self) -> Cloud:
        """Particles drawn from what scans alone tell."""
        poses, clear = self._scans.sought(self._settings.particles)
        return replace(self._cloud(poses), localized=clear)

    def _cloud(self, poses: Array) -> Cloud:
        """Particles at poses (N, 3), whose constants are those of the prior."""
        count = len(poses)
        poses[:, 2] = se2.wrap(poses[:, 2])
        sigmas = np.concatenate((self._odometry_constants.sigmas, self._sensor_constants.sigmas))
        return Cloud(poses, self._rng.standard_normal((count, len(sigmas))) * sigmas, np.full(count, -np.log(count)))

    def _predict(self, increment: Increment) -> None:
        noise = self._rng.standard_normal((len(self._state.poses), 3)) @ positive.root(increment.covariance).T
        poses, _ = self._moved(self._state, increment, noise)
        self._state = replace(self._state, poses=poses)

    def _moved(self, cloud: Cloud, increment: Increment, noise: Array | None = None) -> tuple[Array, Array]:
        """Poses (N, 3) after the increment, each under its own constants, and with body-frame ``noise`` (N, 3), if any.

        Returns also their transition (3, 3+P) from body-frame perturbation and constants. It is taken at the mean of the constants,
        from which those of the particles differ so little that what they change on the way adds to the noise.
        """
        by_constants = np.zeros((3, cloud.constants.shape[1]))
        delta = increment.delta
        if self._odometry_constants.names:
            values = cloud.constants[:, self._odometry_part]
            mean = cloud.weights @ values
            delta, jacobian = recalibrated(increment, self._odometry_constants.full(mean, len(odometry.PARAMETERS)))
            by_constants[:, self._odometry_part] = jacobian[:, list(self._odometry_constants.indices)]
            changed = (values - mean) @ by_constants[:, self._odometry_part].T
            noise = changed if noise is None else noise + changed
        poses = se2.compose(cloud.poses, delta)
        if noise is not None:
            poses = se2.compose(poses, se2.exp(noise))
        return poses, np.concatenate((se2.adjoint(se2.inverse(delta)), by_constants), axis=1)

    def _update(self, m: BearingRange) -> None:
        seen = self._landmarks.factor(m)
        if seen is None:
            return
        since = self._landmarks.refuted_since(m.t, seen, self._odometry, self._state)
        if since is not None:
            self._lost = True
            self._state = replace(self._state, localized=False)
            self._event(f"lost: landmarks are not where they were expected since {since:.1f} s")
        self._state = self._landmarks.averaged(seen, self._state)
        self._weigh(lambda cloud: self._landmarks.log_likelihood(seen, cloud))
        if not self._state.localized and not self._scans.finds:
            self._landmarks.search()
            self._resample()
            self._state = self._landmarks.injected(self._state)
            if self._landmarks.settled(self._state):
                self._state = replace(self._state, localized=True)
                self._seek_from(None)
                self._event("recovered" if self._lost else "localized")

    def _look(self, m: Pixels) -> None:
        if not self._state.localized:
            if self._pixels.seek(m, self._odometry):
                self._go_on_seen("localized")
            return
        seen = self._pixels.factor(m, self._state)
        if seen is not None:
            self._weigh(lambda cloud: self._pixels.log_likelihood(seen, cloud))
        since = self._pixels.refuted_since(m, self._odometry, self._state)
        if since is not None:
            self._records = [r.lost() if r.t >= since else r for r in self._records]
            self._event(f"lost: {MISSED} since {since:.1f} s")
            self._go_on_seen("recovered")

    def _go_on_seen(self, what: str) -> None:
        """Go on where a frame leads to; ``what`` that is, if it is one place."""
        poses, clear = self._pixels.sought(self._settings.particles)
        if clear or not self._scans.finds:
            self._state = replace(self._cloud(poses), localized=clear)
        if clear:
            self._seek_from(None)
            self._scans.start(found=True)
            self._event(what)

    def _scan(self, m: RfidScan) -> None:
        if not self._state.localized and self._scans.finds:
            if self._scans.seek(m, self._odometry):
                self._go_on_found("localized")
            return
        silent = self._scans.silent
        taken = self._scans.track(m, self._odometry, self._state, self._weigh)
        if self._scans.silent and not silent:
            self._event(Silence.EVENT)
        if not taken:
            return
        if self._state.localized:
            self._scans.take_phases(m, self._state, self._places, self._weigh)
        since = self._scans.refuted_since(self._state, self._places)
        if since is not None:
            # for the final trajectory: since then the track was elsewhere
            self._records = [r.lost() if r.t >= since else r for r in self._records]
            self._event(f"lost: tags were not read as they were expected since {since:.1f} s")
            self._go_on_found("recovered")

    def _go_on_found(self, what: str) -> None:
        """Go on where scans alone lead to; ``what`` that is, once it is one place."""
        self._state = self._sought()
        if self._state.localized:
            self._seek_from(None)
            self._scans.start(found=True)
            self._event(what)

    def _went_back(self) -> None:
        self._scans.go_back(self._t)

    def _places(self, times: Array) -> Array:
        """Where the robot was at these times (R,), in the frame of its pose, (R, 3)."""
        if not self._odometry_constants.names:
            return self._motion.places(self._odometry, times)
        mean = self._state.weights @ self._state.constants[:, self._odometry_part]
        return self._motion.places(self._odometry, times, self._odometry_constants.full(mean, len(odometry.PARAMETERS)))

    def _weigh(self, log_likelihood: Callable[[Cloud], Array]) -> float:
        """Weigh the particles by the likelihood, by a share of it at a time if it leaves too few effective ones: they are resampled
        in between (progressive correction: Musso, Oudjane, Le Gland, 2001, section 12.4). Returns the log of its mean.
        RunFailedError if it is not finite for any of them."""
        mean, left = 0.0, 1.0
        while True:
            cloud = self._state
            likelihood = weighable(log_likelihood(cloud), cloud.log_weights, self._t)
            share = largest_share(cloud.log_weights, likelihood, left, self._settings.resample_below * len(cloud.poses))
            weighed = cloud.log_weights + share * likelihood
            log_weights = normalised(weighed)
            heaviest = int(np.argmax(weighed))
            mean += float(weighed[heaviest] - log_weights[heaviest])
            self._state = replace(cloud, log_weights=log_weights)
            left -= share
            if left <= 0.0:
                return mean
            self._resample()

    def _resample(self) -> None:
        chosen = systematic(self._state.weights, self._rng, self._settings.particles)
        if self._settings.kld:
            chosen = chosen[kld.prefix(self._state.poses[chosen], self._rng, self._settings.min_particles)]
        cloud, kernel = self._state.density()
        self._state = cloud.drawn(chosen, kernel, self._rng)

    def _event(self, what: str) -> None:
        # a late measurement makes the filter go through the last ones again
        if (self._t, what) not in self.diagnostics.events:
            self.diagnostics.events.append((self._t, what))

    def _estimate(self) -> PoseEstimate:
        if self._state.localized:
            status: Status = "ambiguous" if self._scans.doubts else "localized"
            return PoseEstimate(self._t, *self._state.moments, status)
        mode = self._state.modes()[0]
        return PoseEstimate(self._t, mode.pose, mode.covariance, "ambiguous")

    def _record(self) -> Record:
        estimate = self._estimate()
        last = next((r.t for r in reversed(self._records) if r.cloud is not None), -np.inf)
        # also where the particles jump, as there is nothing to interpolate
        jumped = bool(self.diagnostics.events) and self.diagnostics.events[-1][0] == self._t
        keep = self._smooth and (jumped or self._t >= last + self._settings.smoothing_interval - 1e-9)
        return Record(self._t, self._odometry, estimate.pose, estimate.covariance, self._state if keep else None)

    def _increment(self, start: Record, end: Record) -> Increment:
        return self._motion.relative(start.odometry, end.odometry)
