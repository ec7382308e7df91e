"""The global search for the robot's pose: at an unknown start, with an unknown heading, after a lost track, in active localization.

Some sensors can find a pose from their own measurements (:class:`~factorgraph_loc.sensors.base.Finder`). Other sensors,
such as RFID, can only weigh given poses. For these, particles anywhere in the map (:mod:`.population`) are weighed by
the measurements of all sensors together. The particles are weighed in slices of fixed cost (:meth:`Search.advance`), so
that measurements are not delayed. :mod:`.tracking` compares the estimated poses with their observations, and starts a
search if they contradict each other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from factorgraph_loc.fusion.population import FEWEST, Evidence, Population
from factorgraph_loc.maps.free_space import FreeSpace
from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.sensors.base import Finder, Sensor
from factorgraph_loc.sensors.known_position import START_KEPT, KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factors import se2
from factors.motion import ChainState
from factors.se2 import Array

DURATION = 60.0  # s: observations of this duration are kept
SLICE = 2_500_000  # computing cost of one slice of the search, in the unit of the module `population`
PAUSE = 0.05  # s: minimum time between two slices, so that a measurement and a request at one time cause only one


class Search:
    """A global search for the robot's pose, by particles and by sensors that can determine a pose. See the module
    docstring.

    ``sensors``: the sensors by name. ``motion``: the odometry. ``space``: the free space that contains the robot. If it
    is None, particles are drawn within the bounds of the sensors' maps. ``fewest``: the minimum number of particles.
    ``work``: the computing cost of one call of :meth:`advance`.
    """

    def __init__(
        self,
        sensors: Mapping[str, Sensor],
        motion: Motion,
        rng: np.random.Generator,
        space: FreeSpace | None = None,
        fewest: int = FEWEST,
        work: float = SLICE,
    ) -> None:
        self._sensors, self._motion, self._work = sensors, motion, work
        self._finders = {name: sensor.finder for name, sensor in sensors.items() if sensor.finder is not None}
        bounds = [s.bounds for s in sensors.values() if s.bounds is not None]
        if space is not None:
            bounds = [np.array((space.centres.min(axis=0), space.centres.max(axis=0)))]
        self._weighs = bool(bounds)  # True if the search uses particles
        within = np.array((np.min(bounds, axis=0)[0], np.max(bounds, axis=0)[1])) if bounds else np.zeros((2, 2))
        self._new_population = partial(Population, motion, within, rng, space=space, fewest=fewest)
        self._population = self._new_population() if self._weighs else None
        self._last: dict[str, float] = {}  # the time [s] of the last observation of each sensor that the particles got
        self._advanced = -math.inf  # s; the time of the last slice
        self._horizon = motion.horizon
        self.newest: ChainState | None = None  # the odometry at the last informative measurement
        self.start: KnownPosition | None = None

    @property
    def possible(self) -> bool:
        """True if the sensors of the search can determine a pose."""
        return bool(self._finders) or self._weighs

    def serves(self, sensor: Sensor) -> bool:
        """Return True if ``sensor`` is one of the search's sensors."""
        return sensor.name in self._sensors

    def remember(self) -> None:
        """Store odometry for longer than by default, so that a search can begin at an earlier time."""
        self._motion.horizon = self._horizon = 2.0 * DURATION

    def begin(self, start: KnownPosition | None) -> None:
        """Begin a search for the heading at the known position ``start``. None begins a search for position and
        heading."""
        self.start = start
        for finder in self._finders.values():
            finder.start = start
        self._motion.horizon = self._horizon if start is None else START_KEPT
        if start is not None and self._weighs:
            self._population = self._new_population(start)

    def look(self, m: Any, odometry: ChainState) -> bool:
        """Process the measurement ``m`` while the pose is unknown. Returns True if the result of the search may have
        changed.

        The result changes if ``m`` alone gives information on the pose, or if the particles have processed an
        observation completely. ``odometry``: the integrated odometry at the time of the measurement.
        """
        sensor, finder = self._sensors.get(m.source), self._finders.get(m.source)
        if sensor is None:
            return False
        is_informative = finder is not None and finder.look(m, odometry)
        if is_informative:
            self.newest = odometry
        if self._population is not None and self._is_due(sensor, odometry.t):
            observation = sensor.evidence(m)
            if observation is not None:
                self._population.add(odometry, observation)
        return self.advance(odometry.t) or is_informative

    def queue(self, observation: Evidence, odometry: ChainState) -> None:
        """Queue an observation of an additional sensor, such as a proximity sensor. The particles process it in
        :meth:`advance`.

        It is ignored if the particles have not yet processed an observation of the search's own sensors. ``odometry``:
        the integrated odometry at the observation's time.
        """
        if self._population is not None and self._population.newest is not None:
            self._population.add(odometry, observation)

    def advance(self, t: float) -> bool:
        """Weigh the particles by queued observations, at a limited computing cost. Returns True if at least one
        observation was processed completely. ``t`` [s]: the current time. A call less than :data:`PAUSE` after the
        previous one does nothing."""
        if self._population is None or (t < self._advanced + PAUSE and self._work < math.inf):
            return False
        self._advanced = t
        if not self._population.advance(self._work):
            return False
        reached = self._population.newest
        if reached is not None and (self.newest is None or reached.t > self.newest.t):
            self.newest = reached
        return True

    @property
    def best(self) -> PosePrior | None:
        """The robot's pose at the time of the last observation, or None if no pose is certain enough yet."""
        for finder in self._finders.values():
            best = finder.best
            if best is not None and not self._denied(best):
                return best
        return None if self._population is None else self._population.best

    @property
    def waits(self) -> bool:
        """True if the particles have not yet processed all queued observations."""
        return self._population is not None and self._population.waits

    def _denied(self, place: PosePrior) -> bool:
        """Return True if the particles contradict ``place``, a pose that was computed from one sensor, or have
        unprocessed observations."""
        return self._population is not None and (self._population.waits or self._population.denies(place))

    def modes(self, t: float) -> list[Mode]:
        """Return the hypotheses of the pose at time ``t`` [s], most likely first. The list is empty as long as no
        measurement gave information on the pose. With a known start position, it is never empty."""
        now, leading = self._motion.state(t), self._leading
        if leading is None or leading.newest is None or not leading.hypotheses:
            return [] if self.start is None else [self.start.mode(now)]
        since = self._motion.relative(leading.newest, now)
        return [
            Mode(h.weight, se2.compose(h.pose, since.delta), h.covariance + se2.body_to_world(h.pose, since.covariance))
            for h in leading.hypotheses
        ]

    def particles(self, t: float) -> tuple[Array, Array] | None:
        """Return poses (N, 3) at time ``t`` [s] and weights (N,) of the particles. Returns None if the search has no
        result, or has it from a single sensor."""
        leading = self._leading
        if not isinstance(leading, Population) or leading.newest is None:
            return None
        poses, weights = leading.particles
        return se2.compose(poses, self._motion.relative(leading.newest, self._motion.state(t)).delta), weights

    def sample(self, rng: np.random.Generator, count: int, now: ChainState) -> tuple[Array, ChainState] | None:
        """Return ``count`` random poses (N, 3) from the result of the search, and the integrated odometry at their
        time. This time is at most that of ``now``, the current odometry. Returns None if there is no result yet."""
        leading = self._leading
        if leading is None:
            return None
        poses, reached = leading.sample(rng, count), leading.newest
        return poses, now if reached is None or reached.t >= now.t else reached

    def end(self) -> None:
        """End the search and delete its measurements. Call this when the pose is known."""
        self.begin(None)
        for finder in self._finders.values():
            finder.clear()
        self._population = None

    @property
    def _leading(self) -> Finder | Population | None:
        """The source of the current result, None if there is no result. It is a finder, which computes a pose from one
        sensor alone, or the particles. Finders that need only one measurement are preferred to particles, and particles
        to other finders."""
        informative = [finder for finder in self._finders.values() if finder.newest is not None]
        for finder in informative:
            if finder.at_once and (self._population is None or finder.best is not None):
                return finder
        if self._population is not None and self._population.newest is not None:
            return self._population
        return next(iter(informative), None)

    def _is_due(self, sensor: Sensor, t: float) -> bool:
        """Return True if the particles may process another observation of ``sensor`` at ``t`` [s], because the last one
        is old enough."""
        last = self._last.get(sensor.name, -math.inf)
        if t <= last or t < last + sensor.evidence_every:
            return False
        self._last[sensor.name] = t
        return True
