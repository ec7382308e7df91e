"""The particle filter ActiveMCL of a robot that chooses its paths (Raoui, Bouyakhf, Devy, ICINCO 2011, Algorithm 2).

One step of the algorithm is this. Propose paths. Predict reads along each path, drawn from the antenna model, and the remaining
entropy. Choose a path and drive it. Update the particles once, by the actual reads. Proposals, predictions and choice are in
:mod:`~factorgraph_loc.planning.policies`, and the loop is in :mod:`~factorgraph_loc.planning.closed_loop`. The particles are those
of the search for an unknown pose (:mod:`~factorgraph_loc.fusion.search`) over free space.

The algorithm as printed is different. Each action has particles of its own, weighted by a scan that was not made.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from factorgraph_loc.fusion.base import EVERY
from factorgraph_loc.fusion.cloud import around
from factorgraph_loc.fusion.search import Search
from factorgraph_loc.maps.free_space import FreeSpace
from factorgraph_loc.model.belief import Belief, Learnt, PoseEstimate, PosePrior, Status
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement, Tick
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.planning.robot import ProximitySensor
from factorgraph_loc.sensors.base import Binding
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.sensors.registry import bound_sensors
from factors.se2 import Array

ONE_PLACE = 0.99  # weight of a mode above which the particles agree on one pose


@dataclass(frozen=True)
class ProximityReading:
    """A measurement of a proximity sensor, as an observation that weights the particles of a filter. ``lengths`` (D,)
    [m]: the measured distances to the next wall in D directions. Constants: ``found`` is the number of detected
    objects, ``work`` the computing cost per pose, ``things`` the detected objects (none)."""

    sensor: ProximitySensor
    lengths: Array
    found: ClassVar[int] = 0
    work: ClassVar[int] = 100
    things: ClassVar[frozenset[str]] = frozenset()

    def log_likelihood(self, poses: Array, values: object) -> Array:
        return self.sensor.log_likelihood(poses, self.lengths)


class ActiveMcl:
    """A particle filter for active localization (ActiveMCL). The start is unknown, and particles are drawn in
    ``space``, the free space of a building. ``particles``: the least number of particles."""

    deterministic = False
    supports_unknown_start = True
    modalities = EVERY

    def __init__(self, setup: Setup, particles: int, space: FreeSpace) -> None:
        self.diagnostics = Diagnostics()
        self._motion = Motion(setup.rig, setup.sensors, self.diagnostics)
        sensors = bound_sensors(Binding(setup, self._motion, self.diagnostics, calibration="none"))
        self._search = Search(sensors, self._motion, setup.rng, space, particles, math.inf)
        self._t = -math.inf
        self._records: list[PoseEstimate] = []

    def initialize(self, prior: PosePrior) -> None:
        raise NotImplementedError("ActiveMCL always starts at an unknown pose")

    def process(self, measurement: Measurement) -> None:
        """Process one measurement. Measurements must be in the order of their times. A :class:`Tick`, a time at which
        the run records the estimate, moves the particles to its time and stores the estimate."""
        if measurement.is_motion:
            self._motion.add(measurement)
            return
        self._t = measurement.t
        if isinstance(measurement, Tick):
            self._search.advance(measurement.t)
            self._records.append(self.estimate())
        else:
            self._search.look(measurement, self._motion.state(measurement.t))

    def see(self, sensor: ProximitySensor, lengths: Array) -> None:
        """Weight the particles by the distances ``lengths`` (D,) [m] to walls that a proximity sensor measured. The
        call has no effect before the particles have processed a measurement of another sensor."""
        self._search.queue(ProximityReading(sensor, lengths), self._motion.state(self._t))
        self._search.advance(self._t)

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """Return the pose and covariance of the mode with the largest weight. The status is ``localized`` if this
        weight is above :data:`ONE_PLACE`, otherwise ``ambiguous``. Without particles the pose is NaN and the status is
        ``unlocalized``. ``t`` [s]: the time of the estimate. None, or an earlier time, means the time of the last
        measurement."""
        at = self._t if t is None else max(t, self._t)
        modes = self._search.modes(at) if self._search.newest is not None else []
        if not modes:
            return PoseEstimate(at, np.full(3, np.nan), np.full((3, 3), np.nan), "unlocalized")
        status: Status = "localized" if modes[0].weight > ONE_PLACE else "ambiguous"
        return PoseEstimate(at, modes[0].pose, modes[0].covariance, status)

    def belief(self, t: float | None = None) -> Belief:
        """Return the modes and the weighted particles at the time ``t`` [s]. None, or an earlier time, means the time
        of the last measurement. If the weight of one mode is above :data:`ONE_PLACE`, only the particles of this mode
        are returned. Without particles the belief is empty."""
        at = self._t if t is None else max(t, self._t)
        particles = self._search.particles(at) if self._search.newest is not None else None
        if particles is None:
            return Belief(())
        modes, (poses, weights) = tuple(self._search.modes(at)), particles
        if modes[0].weight > ONE_PLACE:
            near = around(poses, modes[0].pose)
            poses, weights = poses[near], weights[near] / weights[near].sum()
        return Belief(modes, poses, weights)

    def learnt(self) -> Learnt:
        """Return an empty result, because this estimator learns neither constants nor landmarks."""
        return Learnt()

    def trajectory(self) -> Trajectory:
        """Return the recorded estimates: one for each :class:`Tick` that was processed, from the measurements up to its
        time."""
        poses = np.array([r.pose for r in self._records]).reshape(-1, 3)
        covariances = np.array([r.covariance for r in self._records]).reshape(-1, 3, 3)
        return Trajectory(np.array([r.t for r in self._records]), poses, covariances)
