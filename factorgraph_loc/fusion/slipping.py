"""Whether the odometry contradicts the observations: the wheels slip, or the robot is carried.

One observation that contradicts the track may be wrong. Several that agree on another way of the robot are not. So two hypotheses
compete with the track and with the odometry for the same observations, by their robust likelihoods: the robot goes another share of
the way that the odometry reports, or, if the wheels are at rest, it moves at a constant velocity. When one of them wins the motion
is unknown, for all estimators. That ends when the odometry explains the observations better than the hypotheses.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.sensors.base import Observation, View
from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.motion import ChainState, Increment
from factors.se2 import Array
from factors.update import Correction

WINDOW = 3.0  # s of observations that are compared
ONSETS = (0.75, 1.5, 3.0)  # s ago, when the wheels may have begun to slip, or to hold again
SHARES = (0.0, 0.33, 0.67, 1.5)  # of the way that the odometry reports, which the robot may have gone
SURPRISING = 2.0  # standard deviations of the sum of surprises that starts a comparison
ENOUGH = 2  # observations, of which more are compared
STILL, SPEED = 0.05, 0.5  # m: a way that wheels at rest report; m/s: of a robot that is carried
_ANGLES = np.arange(8) * math.pi / 4.0
# velocities (9, 3) of a robot whose wheels are at rest: none, or carried in some direction
CARRIED = np.concatenate((np.zeros((1, 3)), SPEED * np.column_stack((np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(8)))))
CLEAR = 3.0  # standard deviations of the start that the way must be long
RARE, MOST = 7.0, 3.0  # log-odds that a hypothesis needs, as odometry is seldom wrong; most that one observation adds
EVERY, HOLDS = 1.0, 1.0  # s between comparisons while the wheels slip; log-odds of wheels that hold again


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
                event = f"the odometry contradicts the observations since {onset:.1f} s: the motion is not known"
                self._diagnostics.event(t, event)
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
        ways, start = se2.log(se2.between(states[0], states)), rows[0].corrected()
        length = float(np.hypot(*ways[-1, :2]))
        if length < STILL:
            passed = np.array([row.odometry.t - rows[0].odometry.t for row in rows])
            length = SPEED * passed[-1]
            poses = start + passed[None, :, None] * CARRIED[:, None, :]
        else:
            poses = se2.compose(start, se2.exp(np.array((1.0, *SHARES))[:, None, None] * ways))
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
