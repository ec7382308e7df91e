"""Whether the observations contradict a track: the robot is elsewhere, or the odometry is wrong.

While a track lasts, recent observations are kept with their log-probabilities under the track. Once a sensor doubts the track, the
particles of the search begin with these observations. The track is rejected when the log-odds of another pose exceed
:data:`REFUTING`.

The odometry is wrong where the wheels slip, or where the robot is carried. One observation that contradicts the track may be wrong.
Several that agree on another way of the robot are not. So two hypotheses compete with the track and with the odometry for the same
observations, by their robust likelihoods: the robot goes another share of the way that the odometry reports, or, if the wheels are
at rest, it moves at a constant velocity. When one of them wins the motion is unknown. That ends when the odometry explains the
observations better than the hypotheses.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.fusion.population import WeighedObservation
from factorgraph_loc.fusion.search import DURATION, Search
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Tick
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.sensors.base import Observation, Sensor, View
from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.motion import ChainState, Increment
from factors.se2 import Array
from factors.update import Correction

REFUTING = 8.0  # log-odds against a track that reject it: kidnappings are rare
BEFORE = 2.0  # s: a change is at most this much earlier than a suspicion or its evidence
UNSURE = 5.0  # largest difference of a possible change's log-likelihood from the highest
NEAR, SURE = 0.5, 0.9  # m: a pose is known if its error is below NEAR with probability SURE
CERTAIN = NEAR**2 / (-2.0 * math.log(1.0 - SURE))  # m^2: a pose is known with variances of its position below this sum
PROBATION = 5.0  # s after the rejection of a track: further measurements may contradict the next one
# m, m, rad: standard deviations of the prior at a pose of the search. They are wide: the same measurements enter a graph as
# factors, and the odometry that moved the particles of the search may have failed.
FOUND = np.diag((1.0, 1.0, 0.5)) ** 2
APART = 16.0  # squared Mahalanobis distance: above it a pose differs from the track
WINDOW = 3.0  # s: duration of the compared observations
ONSETS = (0.75, 1.5, 3.0)  # s ago: possible times of the begin or end of wheel slip
SHARES = (0.0, 0.33, 0.67, 1.5)  # possible shares of the reported distance that the robot has driven
SURPRISING = 2.0  # standard deviations of the sum of surprises that starts a comparison
ENOUGH = 2  # a comparison needs more observations
STILL, SPEED = 0.05, 0.5  # m: largest reported distance of wheels at rest; m/s: speed of a carried robot
_ANGLES = np.arange(8) * math.pi / 4.0
# velocities (9, 3) of a robot whose wheels are at rest: none, or carried in some direction
CARRIED = np.concatenate((np.zeros((1, 3)), SPEED * np.column_stack((np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(8)))))
CLEAR = 3.0  # least length of the motion, in standard deviations of its start
RARE, MOST = 7.0, 3.0  # least log-odds of a hypothesis: odometry is seldom wrong; most that one observation adds
EVERY, HOLDS = 1.0, 1.0  # s between comparisons while the wheels slip; log-odds that end a slip
# s: the last time of a carried robot at its old place (-inf if it never was there), and the first time at the new one. Between them
# the pose is unknown and the final trajectory has no poses. Scoring does not interpolate over gaps longer than MAX_GAP, and thus
# not over this one.
Change = tuple[float, float]
SPARE = 1e-3  # s: by this much a gap exceeds MAX_GAP


def is_known(t: Array, changes: Iterable[Change]) -> NDArray[np.bool_]:
    """Whether the pose of the robot is known at times ``t`` (N,)."""
    known = np.ones(len(t), dtype=bool)
    for last, first in changes:
        more = 0.5 * max(MAX_GAP + SPARE - (first - last), 0.0)
        known &= (t <= last - more) | (t >= first + more)
    return known


# sentences of events
LOST = "lost: {why} since {since:.1f} s"
JUMPED = f"{LOST}; goes on at another place"
SLIPS = "the odometry contradicts the observations since {since:.1f} s: the motion is not known"


class Tracked(NamedTuple):
    """The newest pose of a track: the odometry there, and ``pose`` (3,) with body-frame ``covariance`` (3, 3)."""

    odometry: ChainState
    pose: Array
    covariance: Array


class Refuted(NamedTuple):
    """The reason for the rejection of a track, and the time since which it is wrong. ``change``: the robot left the track between
    these times; ``extra_covariance`` (3, 3): added to the covariance of the new pose."""

    why: str
    since: float
    change: Change
    extra_covariance: Array


class Tracking(Search):
    """A search that compares a track with its observations; see the module. ``sensors``: by name."""

    def __init__(
        self, sensors: Mapping[str, Sensor], motion: Motion, rng: np.random.Generator, diagnostics: Diagnostics
    ) -> None:
        super().__init__(sensors, motion, rng)
        self.slips = SlipMonitor(motion, diagnostics)
        self._kept: deque[WeighedObservation] = deque()
        self._looked: deque[float] = deque()  # times of observations of sensors with a finder
        self._since = -math.inf
        self._rejected = -math.inf  # time of the last rejection of a track by particles

    def is_unsure(self, t: float, covariance: Array) -> bool:
        """Whether the pose of a track at ``t``, with ``covariance`` (3, 3), is not known to :data:`NEAR` with probability
        :data:`SURE`, its motion is unknown, or the last track was rejected less than :data:`PROBATION` ago."""
        if self._motion.is_slipping or self._rejected <= t < self._rejected + PROBATION:
            return True
        # the probability is at most that of a circle as wide as the trace
        return bool(covariance[0, 0] + covariance[1, 1] > CERTAIN and beyond(covariance, NEAR) > 1.0 - SURE)

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
        current = observation.at_its_time() if self._weighs else None
        if current is None or not self._is_due(sensor, odometry.t):
            return
        self._kept.append(WeighedObservation(odometry, current, evidence()))
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
        finder = None if isinstance(m, Tick) else self._finders.get(m.source)
        if finder is not None:
            since = finder.refuted_since(m, odometry, pose, covariance)
            if since is not None:
                last = max((t for t in self._looked if t < since), default=-math.inf)
                return Refuted(self._sensors[m.source].lost, since, (last, since), np.zeros((3, 3)))
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
        """The most likely time of the change, and the interval that contains it. Before the change the observations are more likely
        on the track, from then on at the other pose."""
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
        last = max((row.odometry.t for row in self._kept if row.odometry.t < times[possible[-1]]), default=-math.inf)
        return times[int(np.argmax(likelihoods))], (last, times[possible[0]])

    def begin_track(self, *, by_search: bool) -> None:
        """Begin a track: at the pose of the search (``by_search``), with its observations again, or at a given prior."""
        self.end()
        if by_search:
            self._kept.clear()
            self._last.clear()


class _Compared(NamedTuple):
    """An observation and its correction of a predicted ``pose`` (3,) with body-frame ``covariance`` (3, 3).

    ``observed()`` computes the observation. The robot has moved by ``offset`` from ``pose``; ``odometry``: at the observation.
    """

    odometry: ChainState
    observed: Callable[[], Observation | None]
    pose: Array
    covariance: Array
    offset: Increment | None
    correction: Correction

    def fit(self, observation: Observation) -> float:
        """The log-likelihood of the observation at the corrected pose, less half the squared Mahalanobis distance that it moved."""
        delta = self.correction.delta[:3]
        moved = float(positive.squared(delta, self.covariance))
        return float(observation.log_likelihood(self.corrected()[None], {})[0]) - 0.5 * moved

    def corrected(self) -> Array:
        """The pose (3,) of the robot after the correction."""
        pose = se2.moved(self.pose, self.correction.delta[:3])
        return pose if self.offset is None else se2.compose(pose, self.offset.delta)


class SlipMonitor:
    """Detects from the observations of a track that the odometry is wrong, and marks the ``motion`` as unknown.

    An event records each time.
    """

    def __init__(self, motion: Motion, diagnostics: Diagnostics) -> None:
        self._motion, self._diagnostics = motion, diagnostics
        self._rows: deque[_Compared] = deque()
        self._compared = -math.inf  # s: when the wheels were last compared, while they slip

    def add(
        self, observed: Callable[[], Observation | None], odometry: ChainState, view: View, correction: Correction
    ) -> None:
        """Process an observation and the correction of a track by it. ``observed()``: the observation of the pose alone at its own
        time; None if there is none."""
        t = odometry.t
        while self._rows and self._rows[-1].odometry.t > t:  # late measurements are processed again
            self._rows.pop()
        while self._rows and self._rows[0].odometry.t < t - WINDOW:
            self._rows.popleft()
        self._rows.append(_Compared(odometry, observed, view.pose, view.covariance, view.offset, correction))
        if self._motion.is_slipping:
            if t >= self._compared + EVERY:
                self._compared = t
                if min(self._log_odds(t - ago)[0] for ago in ONSETS) < -HOLDS:
                    self._motion.end_slip()
                    self._rows.clear()
            return
        if surprise(correction) > 1.0 and self._are_surprising(t):
            odds, onset = max(self._log_odds(t - ago) for ago in ONSETS)
            if odds > RARE:
                self._diagnostics.event(t, "slip", SLIPS, since=onset)
                self._motion.begin_slip(onset)
                self._compared = t

    def _are_surprising(self, t: float) -> bool:
        """Whether the observations of the last seconds together are more surprising than chance allows."""
        newest = [surprise(row.correction) for row in self._rows if row.odometry.t >= t - WINDOW / 2.0]
        return sum(newest) > SURPRISING * math.sqrt(len(newest))

    def _log_odds(self, begin: float) -> tuple[float, float]:
        """The log-odds that the odometry is wrong since the first observation after ``begin`` that is not surprising, and its time.
        The odds are zero if the pose is not known well enough there."""
        rows = [row for row in self._rows if row.odometry.t >= begin]
        while rows and surprise(rows[0].correction) > 1.0:
            del rows[0]
        if len(rows) <= ENOUGH:
            return 0.0, begin
        states = np.array([row.odometry for row in rows])[:, 1:4]
        motions, start = se2.log(se2.between(states[0], states)), rows[0].corrected()
        length = float(np.hypot(*motions[-1, :2]))
        if length < STILL:
            passed = np.array([row.odometry.t - rows[0].odometry.t for row in rows])
            length = SPEED * passed[-1]
            poses = start + passed[None, :, None] * CARRIED[:, None, :]
        else:
            poses = se2.compose(start, se2.exp(np.array((1.0, *SHARES))[:, None, None] * motions))
        if length < CLEAR * math.sqrt(np.trace(rows[0].correction.covariance[:2, :2])):
            return 0.0, begin
        observations = [observation for row in rows if (observation := row.observed()) is not None]
        if len(observations) < len(rows):
            return 0.0, begin
        by_share = np.array([observations[i].log_likelihood(poses[:, i], {}) for i in range(1, len(rows))])
        holds, slips = by_share[:, :1], by_share[:, 1:]
        odds = np.minimum(slips - holds, MOST).sum(axis=0)
        if odds.max() > RARE and not self._motion.is_slipping:  # else the track follows the observations
            track = np.array([rows[i].fit(observations[i]) for i in range(1, len(rows))])
            odds = np.minimum(odds, np.minimum(slips - track[:, None], MOST).sum(axis=0))
        return float(odds.max()), rows[0].odometry.t


def surprise(correction: Correction) -> float:
    """By how many standard deviations an innovation exceeds its expected size."""
    if correction.dof:
        return (correction.nis - correction.dof) / math.sqrt(2.0 * correction.dof)
    return correction.excess_nll / math.sqrt(correction.variance) if correction.variance > 0.0 else 0.0


def is_doubted(sensors: Iterable[Sensor]) -> bool:
    """Whether one of the sensors doubts the track, or detects nothing where it should."""
    return any(sensor.suspicious_since is not None or sensor.silent for sensor in sensors)


def _is_apart(best: PosePrior, pose: Array, covariance: Array) -> bool:
    error = se2.log(se2.between(pose, best.pose))
    combined = covariance + se2.world_to_body(best.pose, best.covariance)
    return float(error @ positive.solve(combined, error[:, None])[:, 0]) > APART


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
    _, prior = np.linalg.slogdet(covariance)
    _, posterior = np.linalg.slogdet(correction.covariance[:3, :3])
    moved = positive.squared(delta, covariance)
    return float(observation.log_likelihood(at[None], {})[0] - 0.5 * moved + 0.5 * (posterior - prior))
