"""Detection of observations that contradict the track: the robot is at another pose, or the odometry is wrong.

A track is the sequence of estimated poses since the last (re)start of the estimator. Recent observations are kept with
their log-probabilities given the track. When a sensor doubts the track, a search with particles begins with these
observations. The track is rejected when the log-odds of another pose exceed :data:`REFUTING`.

The odometry is wrong if the wheels slip, or if the robot is carried. One observation that contradicts the track may be
an outlier. Several observations that agree on a different motion are not. Two alternatives are therefore compared with
the track and with the odometry, by the robust likelihoods of the same observations:

- the robot has moved a different fraction of the distance that the odometry reports;
- the wheels are at rest, but the robot moves with a constant velocity.

If one alternative is clearly more likely, the motion counts as unknown, until the odometry explains the observations better again.
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

REFUTING = 8.0  # the estimated track is rejected above these log-odds, which are high because robots are rarely carried
BEFORE = 2.0  # s: the robot left the track at most this long before the first observation that contradicts the track
# the robot may have left the track at any time with a log-likelihood that is less than this below the maximum
UNSURE = 5.0
NEAR, SURE = 0.5, 0.9  # m: a pose is known if its error is below NEAR with probability SURE
CERTAIN = NEAR**2 / (-2.0 * math.log(1.0 - SURE))  # m^2: a pose is known if its variances of x and y have a smaller sum
PROBATION = 5.0  # s; for this time after a rejection the new track is not yet reported as localized
# m, m, rad: covariance of the prior at a pose from the search, large because the same measurements are processed again.
FOUND = np.diag((1.0, 1.0, 0.5)) ** 2
APART = 16.0  # squared Mahalanobis distance above which a pose of the search differs from the track
WINDOW = 3.0  # s: the observations of the last WINDOW seconds are compared with the odometry
ONSETS = (0.75, 1.5, 3.0)  # s: possible times since the beginning or end of wheel slip
SHARES = (0.0, 0.33, 0.67, 1.5)  # alternatives for the fraction of the reported distance that the robot has moved
SURPRISING = 2.0  # a comparison starts if the mean of `surprise` over K observations exceeds this divided by sqrt(K)
ENOUGH = 2  # a comparison needs more than this number of observations
STILL, SPEED = 0.05, 0.5  # m: largest reported distance of wheels at rest; m/s: assumed speed of a carried robot
_ANGLES = np.arange(8) * math.pi / 4.0
# Alternatives (9, 3) for the velocity of a robot whose wheels are at rest: none, or SPEED in one of eight directions.
CARRIED = np.concatenate((np.zeros((1, 3)), SPEED * np.column_stack((np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(8)))))
CLEAR = 3.0  # a comparison needs a motion of this many standard deviations of the start position
# Log-odds above which an alternative is accepted, high because odometry is rarely wrong; largest contribution of one observation.
RARE, MOST = 7.0, 3.0
EVERY, HOLDS = 1.0, 1.0  # s: interval between comparisons during a slip; a slip ends at these log-odds for the odometry
# The times [s] between which a robot was carried: the last time at its old pose (-inf if it never was there), and the first time at
# the new pose. In between the pose is unknown, and the final trajectory has no poses. The gap in the trajectory is at least MAX_GAP
# long, because scoring interpolates over shorter gaps.
Change = tuple[float, float]
SPARE = 1e-3  # s: a gap exceeds MAX_GAP by at least this much


def is_known(t: Array, changes: Iterable[Change]) -> NDArray[np.bool_]:
    """Return a mask (N,) that is True at times ``t`` (N,) [s] outside of ``changes``, the intervals when the robot was
    carried."""
    known = np.ones(len(t), dtype=bool)
    for last, first in changes:
        more = 0.5 * max(MAX_GAP + SPARE - (first - last), 0.0)
        known &= (t <= last - more) | (t >= first + more)
    return known


# messages of events
LOST = "lost: {why} since {since:.1f} s"
JUMPED = f"{LOST}; the estimate continues at another pose"
SLIPS = "the odometry contradicts the observations since {since:.1f} s: the motion is not known"


class Tracked(NamedTuple):
    """The newest estimate of the pose. ``pose`` (3,), ``covariance`` (3, 3): its mean, and its covariance in the body
    frame. ``odometry``: the integrated odometry at its time."""

    odometry: ChainState
    pose: Array
    covariance: Array


class Refuted(NamedTuple):
    """The rejection of an estimator's poses since ``since`` [s], because observations contradict them.

    ``why``: the reason, for messages. ``change``: the interval (start, end) [s] that contains the time when the
    estimates became wrong. ``extra_covariance`` (3, 3): is added to the body-frame covariance of the new pose.
    """

    why: str
    since: float
    change: Change
    extra_covariance: Array


class Tracking(Search):
    """A global search that also tests whether observations contradict the track (the estimated poses of the robot)."""

    def __init__(
        self, sensors: Mapping[str, Sensor], motion: Motion, rng: np.random.Generator, diagnostics: Diagnostics
    ) -> None:
        super().__init__(sensors, motion, rng)
        self.slips = SlipMonitor(motion, diagnostics)
        self._kept: deque[WeighedObservation] = deque()
        self._looked: deque[float] = deque()  # times [s] of observations of sensors that can find a pose
        self._since = -math.inf  # s; time of the first doubt about the track
        self._rejected = -math.inf  # s; time of the last rejection of a track by particles

    def is_unsure(self, t: float, covariance: Array) -> bool:
        """Return True if the pose at ``t`` [s], with ``covariance`` (3, 3), should not be reported as localized.

        There are three possible reasons. The position error exceeds :data:`NEAR` with a probability above 1 -
        :data:`SURE`. The motion is unknown. Earlier estimates were rejected less than :data:`PROBATION` ago.
        """
        if self._motion.is_slipping or self._rejected <= t < self._rejected + PROBATION:
            return True
        # cheap test first: if the sum of variances is small, the probability is small for any shape of the covariance
        return bool(covariance[0, 0] + covariance[1, 1] > CERTAIN and beyond(covariance, NEAR) > 1.0 - SURE)

    @property
    def doubts(self) -> bool:
        """True if the measurements of any sensor contradict the estimated poses."""
        return is_doubted(self._sensors.values())

    def expect(self, sensor: Sensor, observation: Observation, odometry: ChainState, view: View) -> None:
        """Process an observation that will correct the pose. If ``sensor`` can determine a pose alone, it compares this
        with the estimated pose. ``odometry``: the integrated odometry at the observation's time. ``view``: gives access
        to the estimator's state before the correction."""
        if sensor.finder is not None:
            sensor.finder.follow(observation, odometry, view)
            self._looked.append(odometry.t)
            while self._looked[0] < odometry.t - DURATION:
                self._looked.popleft()

    def keep(
        self, sensor: Sensor, observation: Observation, odometry: ChainState, evidence: Callable[[], float]
    ) -> None:
        """Store an observation that has corrected the estimated pose, so that a later global search can use it.
        ``odometry``: the integrated odometry at its time. ``evidence()``: returns the log-probability of the
        observation if the estimated pose is right."""
        current = observation.at_its_time() if self._weighs else None
        if current is None or not self._is_due(sensor, odometry.t):
            return
        self._kept.append(WeighedObservation(odometry, current, evidence()))
        while self._kept[0].odometry.t < odometry.t - DURATION:
            self._kept.popleft()
        if self._population is not None:
            self._population.add(*self._kept[-1])

    def refuted(self, m: Any, track: Callable[[], Tracked], pose_at: Callable[[float, Array], Array]) -> Refuted | None:
        """Return the reason to reject the track (the estimated poses), or None. Call this after each measurement.

        If the track is rejected, :attr:`best` is the robot's pose. ``m``: the measurement, or the time of a recorded
        pose. ``track()``: returns the estimated pose at that time. ``pose_at(t, best)``: returns the robot's pose (3,)
        at an earlier time ``t`` [s] if the robot is at ``best`` (3,) now.
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
        """Return ``best``, a pose from the search, predicted by odometry to a later time. ``now``: the integrated
        odometry at that time."""
        if best.t >= now.t:
            return best
        since = self._motion.relative(self._motion.state(best.t), now)
        pose = se2.compose(best.pose, since.delta)
        return PosePrior(now.t, pose, best.covariance + se2.body_to_world(pose, since.covariance))

    def _change(self, best: PosePrior, pose_at: Callable[[float, Array], Array]) -> tuple[float, Change]:
        """Return the most likely time [s] when the track (the estimated poses) became wrong, and an interval that
        contains it.

        ``best``: the robot's current pose. ``pose_at(t, pose)``: returns the pose (3,) at an earlier time ``t`` [s] if
        the current pose is ``pose``. Before the returned time observations are more likely given the track, later given
        ``best``.
        """
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
        """End the search, because the estimator continues at a new pose. ``by_search``: True if the search found this
        pose, and the estimator will process the stored observations again. False if the pose is from a prior."""
        self.end()
        if by_search:
            self._kept.clear()
            self._last.clear()


class _Compared(NamedTuple):
    """An observation that has corrected the estimated pose, to test the odometry against alternative motions.

    ``odometry``: the integrated odometry at its time. ``observed()``: returns the observation as a function of its
    pose, or None. ``pose`` (3,), ``covariance`` (3, 3): the predicted pose and its body-frame covariance. ``offset``:
    the motion from that pose to the observation, or None. ``correction``: the correction of the pose.
    """

    odometry: ChainState
    observed: Callable[[], Observation | None]
    pose: Array
    covariance: Array
    offset: Increment | None
    correction: Correction

    def fit(self, observation: Observation) -> float:
        """Return the log-likelihood of the observation at the corrected pose, minus half the squared Mahalanobis
        distance of the correction."""
        delta = self.correction.delta[:3]
        moved = float(positive.squared(delta, self.covariance))
        return float(observation.log_likelihood(self.corrected()[None], {})[0]) - 0.5 * moved

    def corrected(self) -> Array:
        """Return the corrected pose (3,) of the robot at the time of the observation."""
        pose = se2.moved(self.pose, self.correction.delta[:3])
        return pose if self.offset is None else se2.compose(pose, self.offset.delta)


class SlipMonitor:
    """A detector of wrong odometry (wheel slip, carried robot), which uses the observations that corrected the pose.
    While the odometry is wrong, ``motion`` is marked as unknown. Each detection is an event in ``diagnostics``."""

    def __init__(self, motion: Motion, diagnostics: Diagnostics) -> None:
        self._motion, self._diagnostics = motion, diagnostics
        self._rows: deque[_Compared] = deque()
        self._compared = -math.inf  # s; time of the last comparison during a slip

    def add(
        self, observed: Callable[[], Observation | None], odometry: ChainState, view: View, correction: Correction
    ) -> None:
        """Process an observation that has corrected the estimated pose.

        ``observed()``: returns the observation as a function of the pose at its own time, or None. ``odometry``: the
        integrated odometry at that time. ``view``: gives access to the estimator's state before the correction.
        """
        t = odometry.t
        # a late measurement: remove the later observations, because they will be processed again
        while self._rows and self._rows[-1].odometry.t > t:
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
        """Return True if the last observations differ more from their predictions than is expected from random
        errors."""
        newest = [surprise(row.correction) for row in self._rows if row.odometry.t >= t - WINDOW / 2.0]
        return sum(newest) > SURPRISING * math.sqrt(len(newest))

    def _log_odds(self, begin: float) -> tuple[float, float]:
        """Return the log-odds that the odometry is wrong since a time near ``begin`` [s], and this time [s].

        This time is that of the first observation from ``begin`` on that agrees with its prediction. The log-odds are
        zero with too few observations or too little motion.
        """
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
        # the track must also be less likely than the alternative, except during a slip, when it follows the observations
        if odds.max() > RARE and not self._motion.is_slipping:
            track = np.array([rows[i].fit(observations[i]) for i in range(1, len(rows))])
            odds = np.minimum(odds, np.minimum(slips - track[:, None], MOST).sum(axis=0))
        return float(odds.max()), rows[0].odometry.t


def surprise(correction: Correction) -> float:
    """Return the difference of a correction's squared innovation, or of its negative log-likelihood, from the expected
    value. The unit is the standard deviation."""
    if correction.dof:
        return (correction.nis - correction.dof) / math.sqrt(2.0 * correction.dof)
    return correction.excess_nll / math.sqrt(correction.variance) if correction.variance > 0.0 else 0.0


def is_doubted(sensors: Iterable[Sensor]) -> bool:
    """Return True if the measurements of one of ``sensors`` contradict the estimated poses, or lack expected
    detections."""
    return any(sensor.suspicious_since is not None or sensor.silent for sensor in sensors)


def _is_apart(best: PosePrior, pose: Array, covariance: Array) -> bool:
    """Return True if ``best`` differs significantly from a ``pose`` (3,) with body-frame ``covariance`` (3, 3)."""
    error = se2.log(se2.between(pose, best.pose))
    combined = covariance + se2.world_to_body(best.pose, best.covariance)
    return float(error @ positive.solve(combined, error[:, None])[:, 0]) > APART


def beyond(covariance: Array, distance: float) -> float:
    """Return the probability that a Gaussian position differs from its mean by more than ``distance`` [m].
    ``covariance`` (3, 3): of (x, y, heading) [m, m, rad]."""
    angle = math.pi * np.arange(180) / 180.0
    direction = np.column_stack((np.cos(angle), np.sin(angle)))
    curvature = np.einsum("ni,ij,nj->n", direction, np.linalg.inv(covariance[:2, :2]), direction)
    shares = np.exp(-0.5 * distance**2 * curvature) / curvature
    return float(shares.mean() / np.mean(1.0 / curvature))


def laplace_evidence(observation: Observation, pose: Array, covariance: Array, correction: Correction) -> float:
    """Return the log-likelihood of an observation, marginalised over a Gaussian prediction by Laplace's method.

    ``observation``: depends on the pose only. ``pose`` (3,), ``covariance`` (3, 3): the prediction and its body-frame
    covariance. ``correction``: the correction of this prediction by the observation.
    """
    if correction.evidence is not None:
        return correction.evidence
    delta = correction.delta[:3]
    at = se2.compose(pose, se2.exp(delta))
    _, prior = np.linalg.slogdet(covariance)
    _, posterior = np.linalg.slogdet(correction.covariance[:3, :3])
    moved = positive.squared(delta, covariance)
    return float(observation.log_likelihood(at[None], {})[0] - 0.5 * moved + 0.5 * (posterior - prior))
