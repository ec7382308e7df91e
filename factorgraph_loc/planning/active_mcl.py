"""ActiveMCL, the paper's Algorithm 2, with one set of particles.

As printed, each action has particles of its own, weighted by a scan that was not made, and the index m is both the map and the
particle. Here one step is: propose paths; predict the reads along each, drawn from the antenna model, and the remaining entropy;
choose; move; and update the particles once, by the actual reads. The first three are in
:mod:`~factorgraph_loc.planning.policies`, the loop in :mod:`~factorgraph_loc.planning.closed_loop`. The particles are those of the
search (:mod:`~factorgraph_loc.fusion.search`) over free space.
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
class LengthsSeen:
    """Free ``lengths`` (D,) [m] read by a proximity sensor, as an observation of a search."""

    sensor: ProximitySensor
    lengths: Array
    found: ClassVar[int] = 0
    work: ClassVar[int] = 100
    things: ClassVar[frozenset[str]] = frozenset()

    def log_likelihood(self, poses: Array, values: object) -> Array:
        return self.sensor.log_likelihood(poses, self.lengths)


class ActiveMcl:
    """The search over free ``space`` as an estimator; see the module. ``particles``: their least number."""

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
        raise NotImplementedError("an active robot has an unknown start")

    def process(self, measurement: Measurement) -> None:
        """Take one measurement, in the order of time."""
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
        """Weigh the particles by free lengths (D,) [m] read by a proximity sensor; no effect before the first scan."""
        self._search.queue(LengthsSeen(sensor, lengths), self._motion.state(self._t))
        self._search.advance(self._t)

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The heaviest mode; ``localized`` if nearly all particles are of it."""
        at = self._t if t is None else max(t, self._t)
        modes = self._search.modes(at) if self._search.newest is not None else []
        if not modes:
            return PoseEstimate(at, np.full(3, np.nan), np.full((3, 3), np.nan), "unlocalized")
        status: Status = "localized" if modes[0].weight > ONE_PLACE else "ambiguous"
        return PoseEstimate(at, modes[0].pose, modes[0].covariance, status)

    def belief(self, t: float | None = None) -> Belief:
        """The modes, and the particles: those of one mode only where nearly all are of it."""
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
        """Nothing."""
        return Learnt()

    def trajectory(self) -> Trajectory:
        """The causal estimates at the ticks."""
        poses = np.array([r.pose for r in self._records]).reshape(-1, 3)
        covariances = np.array([r.covariance for r in self._records]).reshape(-1, 3, 3)
        return Trajectory(np.array([r.t for r in self._records]), poses, covariances)
