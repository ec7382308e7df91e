"""The search for the robot's pose where no track gives it: unknown start, unknown heading, lost track, active localization.

Sensors that find a pose from their own measurements propose it (:class:`~factorgraph_loc.sensors.base.Finder`). Others, such as
RFID, only weigh poses: then particles anywhere in the map (:mod:`.population`) are weighed by all sensors, so that their evidence
adds up. While a track lasts, recent observations are kept with their log-probabilities under the track. Once a sensor doubts the
track, the particles begin with these observations; the track is rejected when the log-odds of another pose exceed
:data:`REFUTING`. Particles are weighed in slices of fixed work (:meth:`Search.advance`), so that no measurement waits for them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.fusion.population import FEWEST, Evidence, Population
from factorgraph_loc.maps.free_space import FreeSpace
from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.model.measurement import Tick
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.sensors.base import Finder, Observation, Sensor, View
from factorgraph_loc.sensors.known_position import START_KEPT, KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.motion import ChainState
from factors.se2 import Array
from factors.update import Correction

# s: the last time at which a robot that was carried away was at the old place, -inf if it never was there, and the first at the new
# one. Between them its place is unknown: the final trajectory has no poses there, so that scoring, which goes across no gap of more
# than MAX_GAP, makes up none.
Change = tuple[float, float]
SPARE = 1e-3  # s: a gap is longer than what scoring goes across by so much


def is_known(t: Array, changes: Iterable[Change]) -> NDArray[np.bool_]:
    """At which of the times ``t`` (N,) the robot's place is told."""
    known = np.ones(len(t), dtype=bool)
    for before, after in changes:
        more = 0.5 * max(MAX_GAP + SPARE - (after - before), 0.0)
        known &= (t <= before - more) | (t >= after + more)
    return known


DURATION = 60.0  # s of observations that are kept
REFUTING = 8.0  # log-odds by which a track must lose: kidnappings are rare
BEFORE = 2.0  # s before a suspicion, or before the evidence of a change, in which the change may be
UNSURE = 5.0  # largest difference of a possible change's log-likelihood from the highest
SLICE = 2_500_000  # work (:mod:`.population`) of one slice
PAUSE = 0.05  # s between two slices, at least: a measurement and a tick often come at once
NEAR, SURE = 0.5, 0.9  # m: a pose is known once it is so near with so much probability
PROBATION = 5.0  # s after a track was rejected in which further measurements may contradict the next one
# m, m, rad: spread of a pose that the search found, as a prior of what follows. The same measurements enter a graph as factors. The
# particles that found it were moved along an odometry that may have failed.
FOUND = np.diag((1.0, 1.0, 0.5)) ** 2
APART = 16.0  # squared Mahalanobis distance from the track, beyond which a pose is another one


class WeighedObservation(NamedTuple):
    """An observation on the way, and its log-probability under the track."""

    odometry: ChainState
    observation: Observation
    evidence: float


class Tracked(NamedTuple):
    """The newest pose of a track: the odometry there, and ``pose`` (3,) with body-frame ``covariance`` (3, 3)."""

    odometry: ChainState
    pose: Array
    covariance: Array


class Refuted(NamedTuple):
    """Why a track is rejected, and since when it is wrong; ``change``: between which times the robot left it; ``spread`` (3, 3): to
    be added to the covariance of the new pose."""

    why: str
    since: float
    change: Change
    spread: Array


class Search:
    """The search; see the module. ``sensors``: by name. ``space``: where the robot may be, by default
    within the bounds of the sensors; ``fewest``: least number of particles; ``work``: of one slice."""

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
        self._weighs = bool(bounds)  # whether particles are weighed
        within = np.array((np.min(bounds, axis=0)[0], np.max(bounds, axis=0)[1])) if bounds else np.zeros((2, 2))
        self._new_population = partial(Population, motion, within, rng, space=space, fewest=fewest)
        self._population = self._new_population() if self._weighs else None
        self._kept: deque[WeighedObservation] = deque()
        self._looked: deque[float] = deque()  # times of observations of sensors with a finder
        self._last: dict[str, float] = {}  # time of each sensor's last evidence
        self._since = -math.inf
        self._advanced = -math.inf  # time of the last slice
        self._horizon = motion.horizon
        self._rejected = -math.inf  # time of the last rejection of a track by particles
        self._unsure = False  # whether a track found by particles has not yet been known to half a metre
        self.newest: ChainState | None = None  # the odometry at the last informative measurement
        self.start: KnownPosition | None = None

    @property
    def possible(self) -> bool:
        """Whether any measurement could give a pose."""
        return bool(self._finders) or self._weighs

    def serves(self, sensor: Sensor) -> bool:
        """Whether the search uses a sensor."""
        return sensor.name in self._sensors

    def remember(self) -> None:
        """Keep the odometry for a search on the way."""
        self._motion.keep(2.0 * DURATION)
        self._horizon = 2.0 * DURATION

    def begin(self, start: KnownPosition | None) -> None:
        """Search the heading at a known position; None ends that."""
        self.start = start
        for finder in self._finders.values():
            finder.start = start
        self._motion.keep(self._horizon if start is None else START_KEPT)
        if start is not None and self._weighs:
            self._population = self._new_population(start)

    def look(self, m: Any, odometry: ChainState) -> bool:
        """Process a measurement while the pose is unknown; False if it is uninformative."""
        sensor, finder = self._sensors.get(m.source), self._finders.get(m.source)
        if sensor is None:
            return False
        told = finder is not None and finder.look(m, odometry)
        if told:
            self.newest = odometry
        if self._population is not None and self._is_due(sensor, odometry.t):
            seen = sensor.evidence(m)
            if seen is not None:
                self._population.add(odometry, seen)
        return self.advance(odometry.t) or told

    def weigh(self, observation: Evidence, odometry: ChainState) -> None:
        """Weigh the particles by an observation that is not a sensor's, once they have begun."""
        if self._population is not None and self._population.newest is not None:
            self._population.add(odometry, observation)

    def advance(self, t: float) -> bool:
        """Weigh the particles for one slice of work at ``t``; whether an observation was completed."""
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
        """The pose, at its time, if one is clear; else None."""
        for finder in self._finders.values():
            found = finder.best
            if found is not None and not self._denied(found):
                return found
        return None if self._population is None else self._population.best

    @property
    def waits(self) -> bool:
        """Whether an observation is not yet weighed."""
        return self._population is not None and self._population.waits

    def _denied(self, place: PosePrior) -> bool:
        """Whether the particles reject this pose, or have not processed the measurement it came from."""
        return self._population is not None and (self._population.waits or self._population.denies(place))

    def modes(self, t: float) -> list[Mode]:
        """Hypotheses of the pose at ``t``, most likely first; at least one for a known start position."""
        now, leading = self._motion.state(t), self._leading
        if leading is None or leading.newest is None or not leading.hypotheses:
            return [] if self.start is None else [self.start.mode(now)]
        since = self._motion.relative(leading.newest, now)
        return [
            Mode(h.weight, se2.compose(h.pose, since.delta), h.covariance + se2.body_to_world(h.pose, since.covariance))
            for h in leading.hypotheses
        ]

    def particles(self, t: float) -> tuple[Array, Array] | None:
        """Poses (N, 3) at ``t`` and weights (N,) of the particles, if these lead the search."""
        leading = self._leading
        if not isinstance(leading, Population) or leading.newest is None:
            return None
        poses, weights = leading.particles
        return se2.compose(poses, self._motion.relative(leading.newest, self._motion.state(t)).delta), weights

    def sample(self, rng: np.random.Generator, count: int, now: ChainState) -> tuple[Array, ChainState] | None:
        """Random poses (N, 3), and the odometry there, not later than ``now``; None before any informative measurement."""
        leading = self._leading
        if leading is None:
            return None
        poses, reached = leading.sample(rng, count), leading.newest
        return poses, now if reached is None or reached.t >= now.t else reached

    def is_unsure(self, t: float, covariance: Array) -> bool:
        """Whether a track that particles found, or whose motion was unknown, has not been known since to :data:`NEAR` with
        probability :data:`SURE`, nor is by its ``covariance`` (3, 3) at ``t``; whether its motion is unknown; or whether the last
        track was rejected less than :data:`PROBATION` ago."""
        if self._motion.is_slipping or self._rejected <= t < self._rejected + PROBATION:
            return True
        return self._unsure and beyond(covariance, NEAR) > 1.0 - SURE

    @property
    def doubts(self) -> bool:
        """Whether a sensor doubts the track."""
        return is_doubted(self._sensors.values())

    def expect(self, sensor: Sensor, observation: Observation, odometry: ChainState, view: View) -> None:
        """Record an observation that is about to be applied to a track."""
        if sensor.finder is not None:
            sensor.finder.follow(observation, odometry, view)
            self._looked.append(odometry.t)
            while self._looked[0] < odometry.t - DURATION:
                self._looked.popleft()

    def keep(
        self, sensor: Sensor, observation: Observation, odometry: ChainState, evidence: Callable[[], float]
    ) -> None:
        """Keep an observation that was applied to a track; ``evidence()``: its log-probability under the track."""
        seen = observation.at_its_time() if self._weighs else None
        if seen is None or not self._is_due(sensor, odometry.t):
            return
        self._kept.append(WeighedObservation(odometry, seen, evidence()))
        while self._kept[0].odometry.t < odometry.t - DURATION:
            self._kept.popleft()
        if self._population is not None:
            self._population.add(*self._kept[-1])

    def refuted(self, m: Any, track: Callable[[], Tracked], pose_at: Callable[[float, Array], Array]) -> Refuted | None:
        """Why a track is wrong, if it is, after a measurement was applied to it, or at a tick; :attr:`best` is where the robot is.

        ``track()``: the track at the measurement. ``pose_at(t, best)``: where the robot was at ``t`` if it is at ``best`` (3,) now.
        """
        if isinstance(m, Tick) and not self.waits:
            return None
        odometry, pose, covariance = track()
        self._unsure = self.is_unsure(odometry.t, covariance)
        finder = None if isinstance(m, Tick) else self._finders.get(m.source)
        if finder is not None:
            since = finder.refuted_since(m, odometry, pose, covariance)
            if since is not None:
                before = max((t for t in self._looked if t < since), default=-math.inf)
                return Refuted(self._sensors[m.source].lost, since, (before, since), np.zeros((3, 3)))
        return self._refuted_by_all(odometry, pose, covariance, pose_at)

    def _refuted_by_all(
        self, odometry: ChainState, pose: Array, covariance: Array, pose_at: Callable[[float, Array], Array]
    ) -> Refuted | None:
        doubting = {s: since for s in self._sensors.values() if (since := s.suspicious_since) is not None}
        if not doubting or not self._weighs:
            self._population = None
            return None
        if self._population is None:
            self._population, self._since = self._new_population(), min(doubting.values())
            for row in self._kept:
                if row.odometry.t >= self._since:
                    self._population.add(*row)
        best = self._population.best if self.advance(odometry.t) else None
        if best is None:
            return None
        best = self.brought(best, odometry)
        if not _is_apart(best, pose, covariance):
            for sensor in doubting:
                sensor.accept()
            self._population = None
            return None
        if self._population.log_evidence - self._population.rival_evidence <= REFUTING:
            return None
        self._rejected = odometry.t
        return Refuted(next(iter(doubting)).lost, *self._change(best, pose_at), FOUND)

    def brought(self, best: PosePrior, now: ChainState) -> PosePrior:
        """A pose moved to where the odometry is ``now``."""
        if best.t >= now.t:
            return best
        since = self._motion.relative(self._motion.state(best.t), now)
        pose = se2.compose(best.pose, since.delta)
        return PosePrior(now.t, pose, best.covariance + se2.body_to_world(pose, since.covariance))

    def _change(self, best: PosePrior, pose_at: Callable[[float, Array], Array]) -> tuple[float, Change]:
        """The most likely time of the change: from then on the observations are more likely at the other pose, before on the
        track. And the observations between which it may have been."""
        times: list[float] = []
        likelihoods: list[float] = []  # logarithms, of a change just before each time
        total, highest, earliest = 0.0, -math.inf, self._since
        for row in reversed(self._kept):
            t = row.odometry.t
            if t < earliest - BEFORE:
                break
            total += float(row.observation.log_likelihood(pose_at(t, best.pose)[None], {})[0]) - row.evidence
            times.append(t)
            likelihoods.append(total)
            highest = max(highest, total)
            if total >= highest - UNSURE:
                earliest = min(earliest, t)
        possible = np.flatnonzero(np.array(likelihoods) >= highest - UNSURE)
        before = max((row.odometry.t for row in self._kept if row.odometry.t < times[possible[-1]]), default=-math.inf)
        return times[int(np.argmax(likelihoods))], (before, times[possible[0]])

    def begin_track(self, *, found: bool) -> None:
        """A track begins: where the search ``found`` it, with the observations that led there again, or at a given prior."""
        self.begin(None)
        self._unsure = found and self._weighs  # a finder states the covariance of its pose
        if found:
            self._kept.clear()
            self._last.clear()
        for finder in self._finders.values():
            finder.clear()
        self._population = None

    @property
    def _leading(self) -> Finder | Population | None:
        """Which source leads: a finder that one measurement is enough for, else the particles, else any finder."""
        told = [finder for finder in self._finders.values() if finder.newest is not None]
        for finder in told:
            if finder.at_once and (self._population is None or finder.best is not None):
                return finder
        if self._population is not None and self._population.newest is not None:
            return self._population
        return next(iter(told), None)

    def _is_due(self, sensor: Sensor, t: float) -> bool:
        """Whether a sensor's last evidence is long enough ago."""
        last = self._last.get(sensor.name, -math.inf)
        if t <= last or t < last + sensor.evidence_every:
            return False
        self._last[sensor.name] = t
        return True


def is_doubted(sensors: Iterable[Sensor]) -> bool:
    """Whether one of the sensors doubts the track, or detects nothing where it should."""
    return any(sensor.suspicious_since is not None or sensor.silent for sensor in sensors)


def _is_apart(best: PosePrior, pose: Array, covariance: Array) -> bool:
    error = se2.log(se2.between(pose, best.pose))
    spread = covariance + se2.world_to_body(best.pose, best.covariance)
    return float(error @ positive.solve(spread, error[:, None])[:, 0]) > APART


def beyond(covariance: Array, distance: float) -> float:
    """The probability that a Gaussian of this ``covariance`` (3, 3) is farther from its mean position than ``distance`` [m]."""
    angle = math.pi * np.arange(180) / 180.0
    direction = np.column_stack((np.cos(angle), np.sin(angle)))
    curvature = np.einsum("ni,ij,nj->n", direction, np.linalg.inv(covariance[:2, :2]), direction)
    shares = np.exp(-0.5 * distance**2 * curvature) / curvature
    return float(shares.mean() / np.mean(1.0 / curvature))


def laplace_evidence(observation: Observation, pose: Array, covariance: Array, correction: Correction) -> float:
    """The log of the probability of an observation of the pose alone, by Laplace's method: at its correction of a Gaussian, with
    ``pose`` (3,) and body-frame ``covariance`` (3, 3)."""
    if correction.evidence is not None:
        return correction.evidence
    delta = correction.delta[:3]
    at = se2.compose(pose, se2.exp(delta))
    _, before = np.linalg.slogdet(covariance)
    _, after = np.linalg.slogdet(correction.covariance[:3, :3])
    moved = positive.squared(delta, covariance)
    return float(observation.log_likelihood(at[None], {})[0] - 0.5 * moved + 0.5 * (after - before))
