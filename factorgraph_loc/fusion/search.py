"""Where the robot is when no track tells it: an unknown start, a heading that is not known, a robot that was carried elsewhere.

Sensors that tell a place by themselves have finders. Where one only says how likely a place is, as RFID does, particles that begin
anywhere are weighed by what all sensors see (:mod:`.population`), so that their evidence adds up. On the way what was seen is kept
with the track's own evidence; when the track comes under suspicion the same search begins among what was seen since then, and
refutes the track if "somewhere else" has become so much likelier than it. The particles are weighed in slices
(:meth:`Search.advance`), beside the track, so that no measurement has to wait for the search.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from factorgraph_loc.fusion.changes import Change
from factorgraph_loc.fusion.population import Population
from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.model.measurement import Tick
from factorgraph_loc.sensors.base import Observation, Sensor, View
from factorgraph_loc.sensors.known_position import START_KEPT, KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.motion import ChainState
from factors.se2 import Array
from factors.update import Correction

DURATION = 60.0  # s of observations that are kept
REFUTING = 8.0  # log of the odds that a track must lose by: kidnappings are rare
BEFORE = 2.0  # s before a suspicion, or before what speaks for a change, in which it may lie
UNSURE = 5.0  # a change may be at a time for which the log of its likelihood is so much below the highest
SLICE = 2_500_000  # of work (:mod:`.population`) that is done at a measurement or a tick
PAUSE = 0.05  # s between two slices, at least: a measurement and a tick often come at once
NEAR, SURE = 0.5, 0.9  # m: a place that was found is known once it is so near with so much probability
APART = 16.0  # squared Mahalanobis distance to the track, beyond which it is another place


class WeighedObservation(NamedTuple):
    """An observation on the way, and the log of its probability under the track."""

    odometry: ChainState
    observation: Observation
    evidence: float


class Tracked(NamedTuple):
    """Where a track has come to: the odometry, and the ``pose`` (3,) with its body-frame ``covariance`` (3, 3)."""

    odometry: ChainState
    pose: Array
    covariance: Array


class Refuted(NamedTuple):
    """Why a track is given up, and since when it was wrong; ``change``: between which times the robot left it."""

    why: str
    since: float
    change: Change


class Search:
    """The search; see the module. ``sensors``: by the modality of their measurements."""

    def __init__(self, sensors: Mapping[str, Sensor], motion: Motion, rng: np.random.Generator) -> None:
        self._sensors, self._motion, self._rng = sensors, motion, rng
        self._finders = {name: sensor.finder for name, sensor in sensors.items() if sensor.finder is not None}
        bounds = [s.bounds for s in sensors.values() if s.bounds is not None]
        self._bounds = None if not bounds else np.array((np.min(bounds, axis=0)[0], np.max(bounds, axis=0)[1]))
        self._population = self._new_population(None)
        self._kept: deque[WeighedObservation] = deque()
        self._looked: deque[float] = deque()  # when finders' sensors told something on the way
        self._last: dict[str, float] = {}  # when a sensor last told something new of a place
        self._newest: ChainState | None = None
        self._since = -math.inf
        self._advanced = -math.inf  # when a slice of work was done last
        self._horizon = motion.horizon
        self._unsure = False  # whether a track that particles found has not yet been known to half a metre
        self.start: KnownPosition | None = None

    @property
    def possible(self) -> bool:
        """Whether anything that may be seen tells a place."""
        return bool(self._finders) or self._bounds is not None

    def remember(self) -> None:
        """Keep the odometry that a search on the way needs."""
        self._motion.keep(2.0 * DURATION)
        self._horizon = 2.0 * DURATION

    def begin(self, start: KnownPosition | None) -> None:
        """Seek the heading of a start whose position is known; None: that is over."""
        self.start = start
        for finder in self._finders.values():
            finder.start = start
        self._motion.keep(self._horizon if start is None else START_KEPT)
        if start is not None:
            self._population = self._new_population(start)

    def look(self, m: Any, odometry: ChainState) -> bool:
        """Take a measurement while no place is known; False where it tells nothing."""
        sensor, finder = self._sensors.get(m.modality), self._finders.get(m.modality)
        if sensor is None:
            return False
        told = finder is not None and finder.look(m, odometry)
        if told:
            self._newest = odometry
        if self._population is not None and self._is_due(sensor, odometry.t):
            seen = sensor.evidence(m)
            if seen is not None:
                self._population.add(odometry, seen)
        return self.advance(odometry.t) or told

    def advance(self, t: float) -> bool:
        """Go on at ``t`` with what waits, for one slice of work; whether that told something of a place."""
        if self._population is None or t < self._advanced + PAUSE:
            return False
        self._advanced = t
        if not self._population.advance(SLICE):
            return False
        reached = self._population.odometry
        if reached is not None and (self._newest is None or reached.t > self._newest.t):
            self._newest = reached
        return True

    @property
    def newest(self) -> ChainState | None:
        """The odometry at the last measurement that told something."""
        return self._newest

    @property
    def best(self) -> PosePrior | None:
        """The one place that is clear, at its time; None where there is none."""
        for finder in self._finders.values():
            found = finder.best
            if found is not None and not self._denied(found):
                return found
        return None if self._population is None else self._population.best

    @property
    def waits(self) -> bool:
        """Whether there is something that was seen and not weighed yet."""
        return self._population is not None and self._population.waits

    def _denied(self, place: PosePrior) -> bool:
        """Whether the particles tell against a place, or have not yet seen what told it."""
        return self._population is not None and (self._population.waits or self._population.denies(place))

    def modes(self, t: float) -> list[Mode]:
        """Where the robot may be at ``t``, the likeliest place first; none where what was seen tells none. Of a start whose
        position is known there is always one."""
        now = self._motion.state(t)
        at, found = self._hypotheses()
        if at is None or not found:
            return [] if self.start is None else [self.start.mode(now)]
        since = self._motion.relative(at, now)
        return [
            Mode(h.weight, se2.compose(h.pose, since.delta), h.covariance + se2.body_to_world(h.pose, since.covariance))
            for h in found
        ]

    def particles(self, t: float) -> tuple[Array, Array] | None:
        """Poses (N, 3) at ``t`` and weights (N,) of the particles that are anywhere, if these lead the search."""
        reached = None if self._population is None else self._population.odometry
        if self._population is None or reached is None or self._at_once() is not None:
            return None
        poses, weights = self._population.particles
        return se2.compose(poses, self._motion.relative(reached, self._motion.state(t)).delta), weights

    def sample(self, rng: np.random.Generator, count: int, now: ChainState) -> tuple[Array, ChainState] | None:
        """Poses (N, 3) drawn from what is known, and the odometry there, not later than ``now``; None where nothing was seen."""
        leading = self._at_once()
        if leading is None and self._population is not None and self._population.odometry is not None:
            poses, reached = self._population.sample(rng, count), self._population.odometry
        else:
            if leading is None:
                leading = next((f for f in self._finders.values() if f.newest is not None), None)
            if leading is None:
                return None
            poses, reached = leading.sample(rng, count), leading.newest
        return poses, now if reached is None or reached.t >= now.t else reached

    def is_unsure(self, covariance: Array) -> bool:
        """Whether a track that particles found has not yet been known to :data:`NEAR` with probability :data:`SURE`, nor is by its
        ``covariance`` (3, 3) now."""
        return self._unsure and beyond(covariance, NEAR) > 1.0 - SURE

    @property
    def doubts(self) -> bool:
        """Whether a track, or a sensor, is under suspicion."""
        return any(s.suspicious_since is not None or s.silent or s.inconsistent for s in self._sensors.values())

    def expect(self, sensor: Sensor, observation: Observation, odometry: ChainState, view: View) -> None:
        """An observation is about to be applied to a track."""
        if sensor.finder is not None:
            sensor.finder.follow(observation, odometry, view)
            self._looked.append(odometry.t)
            while self._looked[0] < odometry.t - DURATION:
                self._looked.popleft()

    def keep(
        self, sensor: Sensor, observation: Observation, odometry: ChainState, evidence: Callable[[], float]
    ) -> None:
        """An observation was applied to a track, under which ``evidence`` tells the log of its probability."""
        seen = observation.at_its_time() if self._bounds is not None else None
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
        self._unsure = self.is_unsure(covariance)
        finder = None if isinstance(m, Tick) else self._finders.get(m.modality)
        if finder is not None:
            since = finder.refuted_since(m, odometry, pose, covariance)
            if since is not None:
                before = max((t for t in self._looked if t < since), default=-math.inf)
                return Refuted(self._sensors[m.modality].lost, since, (before, since))
        return self._refuted_by_all(odometry, pose, covariance, pose_at)

    def _refuted_by_all(
        self, odometry: ChainState, pose: Array, covariance: Array, pose_at: Callable[[float, Array], Array]
    ) -> Refuted | None:
        doubting = {s: since for s in self._sensors.values() if (since := s.suspicious_since) is not None}
        if not doubting or self._bounds is None:
            self._population = None
            return None
        if self._population is None:
            self._population, self._since = self._new_population(None), min(doubting.values())
            assert self._population is not None
            for row in self._kept:
                if row.odometry.t >= self._since:
                    self._population.add(*row)
        best = self._population.best if self.advance(odometry.t) else None
        if best is None:
            return None
        best = self._brought(best, odometry)
        if not _is_apart(best, pose, covariance):
            for sensor in doubting:
                sensor.accept()
            self._population = None
            return None
        if self._population.log_evidence - self._population.rival_evidence <= REFUTING:
            return None
        return Refuted(next(iter(doubting)).lost, *self._change(best, pose_at))

    def _brought(self, best: PosePrior, now: ChainState) -> PosePrior:
        """A place where the odometry is at ``now``."""
        since = self._motion.relative(self._motion.state(best.t), now)
        pose = se2.compose(best.pose, since.delta)
        return PosePrior(now.t, pose, best.covariance + se2.body_to_world(pose, since.covariance))

    def _change(self, best: PosePrior, pose_at: Callable[[float, Array], Array]) -> tuple[float, Change]:
        """When the robot must have come to the other place: from then on what was seen is likelier there, before on the track. And
        between which observations that may have been."""
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
        """A track begins: where the search ``found`` it, with what was seen again that led there, or where it was said to."""
        self.begin(None)
        self._unsure = found and self._bounds is not None  # what tells a place by itself has said how near it is
        if found:
            self._kept.clear()
            self._last.clear()
        for finder in self._finders.values():
            finder.clear()
        self._population = None

    def _hypotheses(self) -> tuple[ChainState | None, Sequence[Mode]]:
        leading = self._at_once()
        if leading is None and self._population is not None and self._population.odometry is not None:
            return self._population.odometry, self._population.hypotheses
        if leading is None:
            leading = next((f for f in self._finders.values() if f.newest is not None), None)
        return (None, ()) if leading is None else (leading.newest, leading.hypotheses)

    def _at_once(self) -> Any:
        """A finder that one measurement has told a place."""
        told = (f for f in self._finders.values() if f.at_once and f.newest is not None)
        return next((f for f in told if self._population is None or f.best is not None), None)

    def _is_due(self, sensor: Sensor, t: float) -> bool:
        last = self._last.get(sensor.modality, -math.inf)
        if t <= last or t < last + sensor.evidence_every:
            return False
        self._last[sensor.modality] = t
        return True

    def _new_population(self, start: KnownPosition | None) -> Population | None:
        return None if self._bounds is None else Population(self._motion, self._bounds, self._rng, start)


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
