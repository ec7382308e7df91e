"""Global localization from measured positions alone, at an unknown start or after the robot was carried.

The positions of the last minute are aligned with the path of the odometry. The heading becomes known when the robot has
travelled far enough. An estimated pose is rejected if the positions of the last ten seconds agree on another pose.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.sensors.base import View
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.motion import ChainState, Increment
from factors.positions.factor import PositionFactor
from factors.robust import geman_mcclure_weight
from factors.se2 import Array
from factors.update import GATE

DURATION, INTERVAL = 60.0, 0.5  # s; age of the oldest position that is used, and minimum time between positions
FEWEST, SHARE = 5, 0.8  # a pose needs at least FEWEST positions, and at least the fraction SHARE of inliers
HEADING = 0.15  # rad; largest standard deviation of a known heading
WIDENINGS = (64.0, 16.0, 4.0, 1.0, 1.0, 1.0)  # multiplies the scale of the robust loss in each iteration
BEYOND = 2.0  # a position contradicts the estimated pose if its squared innovation exceeds BEYOND * GATE
CONTRADICTED = 10.0  # s; positions that contradict the pose for this time mean a wrong pose and not wrong positions
SEARCH_INTERVAL = 1.0  # s between searches while positions contradict the pose


class Row(NamedTuple):
    """A measured position. ``odometry``: the odometry state at the time of the measurement. ``factor``: a factor on the
    pose at this time."""

    odometry: ChainState
    factor: PositionFactor


class PositionFinder:
    """Global localization by measured positions. It implements :class:`~factorgraph_loc.sensors.base.Finder`.
    ``observation``: a function that returns the observation of a measurement, as a constraint on the pose at its
    time."""

    at_once = False

    def __init__(self, observation: Callable[[Any], Any], motion: Motion) -> None:
        self._observation, self._motion = observation, motion
        self._rows: deque[Row] = deque()
        self._beyond: deque[tuple[float, bool]] = deque()
        self._robust = 4.0
        self.hypotheses: tuple[Mode, ...] = ()
        self.best: PosePrior | None = None
        self.start: KnownPosition | None = None
        self.newest: ChainState | None = None

    @property
    def suspicious_since(self) -> float | None:
        """The time [s] since which all positions contradict the estimated pose, or None if this time is too short."""
        if not self._beyond or not all(beyond for _, beyond in self._beyond):
            return None
        first, last = self._beyond[0][0], self._beyond[-1][0]
        return first if last - first >= CONTRADICTED - INTERVAL and len(self._beyond) >= FEWEST else None

    def look(self, m: Any, odometry: ChainState) -> bool:
        self._add(odometry, self._observation(m).factor)
        self._align(odometry)
        self.newest = odometry
        return True

    def follow(self, observation: Any, odometry: ChainState, view: View) -> None:
        factor = observation.factor
        self._add(odometry, factor)
        while self._beyond and self._beyond[-1][0] >= observation.t:
            self._beyond.pop()
        self._beyond.append((observation.t, factor.squared(view.pose, view.covariance) > BEYOND * GATE))
        while self._beyond[0][0] < observation.t - CONTRADICTED:
            self._beyond.popleft()

    def refuted_since(self, m: Any, odometry: ChainState, pose: Array, covariance: Array) -> float | None:
        since = self.suspicious_since
        if since is None or (self.newest is not None and odometry.t < self.newest.t + SEARCH_INTERVAL):
            return None
        while self._rows and self._rows[0].odometry.t < since:
            self._rows.popleft()
        self._align(odometry)
        self.newest = odometry
        if self.best is None:
            return None
        world = se2.body_to_world(pose, covariance) + self.best.covariance
        error = np.append(self.best.pose[:2] - pose[:2], se2.wrap_scalar(float(self.best.pose[2] - pose[2])))
        return since if positive.squared(error, world) > BEYOND * GATE else None

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` random poses (N, 3) at the last position, or (0, 3) without one. An unknown heading is
        uniform."""
        if not self.hypotheses:
            return np.empty((0, 3))
        (mode,) = self.hypotheses
        poses = mode.pose + positive.draws(mode.covariance, count, rng)
        if mode.covariance[2, 2] > 1.0:
            poses[:, 2] = (rng.permutation(count) + rng.random(count)) * 2.0 * math.pi / count
        return np.asarray(np.column_stack((poses[:, :2], se2.wrap(poses[:, 2]))))

    def clear(self) -> None:
        self._beyond.clear()

    def _add(self, odometry: ChainState, factor: PositionFactor) -> None:
        """Store a position: its ``odometry`` state and its ``factor``. It is skipped if it is not later than the last
        stored position. The last stored position is replaced if it is less than INTERVAL after the one before."""
        self._robust = factor.robust
        if self._rows and odometry.t <= self._rows[-1].odometry.t:
            return
        if len(self._rows) > 1 and self._rows[-1].odometry.t < self._rows[-2].odometry.t + INTERVAL:
            self._rows.pop()
        self._rows.append(Row(odometry, replace(factor, offset=None)))
        while self._rows[0].odometry.t < odometry.t - DURATION:
            self._rows.popleft()

    def _align(self, now: ChainState) -> None:
        """Align the path of the odometry with the positions by robust least squares. Store the pose at the odometry
        state ``now`` in ``hypotheses``, and in ``best`` if it is unambiguous."""
        rows = list(self._rows)
        if self.start is not None:
            known = self.start.prior
            at_start = PositionFactor(known.pose[:2], known.covariance[:2, :2], np.zeros(2), self._robust)
            rows.insert(0, Row(self.start.odometry, at_start))
        factors = [self._factor_at(now, row) for row in rows]
        pose = se2.align_points(np.array([f.point for f in factors]), np.array([f.position for f in factors]))
        for widening in WIDENINGS:
            parts = [factor.whitened([pose]) for factor in factors]
            residual = np.concatenate([error for error, _ in parts])
            jacobian = np.concatenate([by_pose for _, (by_pose,) in parts])
            squared = np.einsum("ni,ni->n", residual, residual)
            weight = geman_mcclure_weight(squared, widening * self._robust)
            information = np.einsum("nij,n,nik->jk", jacobian, weight, jacobian) + 1e-9 * np.eye(3)
            gradient = np.einsum("nij,n,ni->j", jacobian, weight, residual)
            pose = se2.compose(pose, se2.exp(-np.linalg.solve(information, gradient)))
        covariance = se2.body_to_world(pose, np.linalg.inv(information))
        is_known = len(rows) > 1 and covariance[2, 2] < 1.0
        if not is_known:
            covariance = np.diag((*np.diag(rows[-1].factor.covariance), math.pi**2 / 3.0))
            pose = np.array((*rows[-1].factor.position, 0.0))
        self.hypotheses = (Mode(1.0, pose, covariance),)
        agree = is_known and len(rows) >= FEWEST and float(np.mean(squared < GATE)) >= SHARE
        self.best = PosePrior(now.t, pose, covariance) if agree and covariance[2, 2] < HEADING**2 else None

    def _factor_at(self, now: ChainState, row: Row) -> PositionFactor:
        """Return the factor of the position ``row`` as a function of the pose at the odometry state ``now``."""
        step = self._motion.relative(row.odometry, now)
        carried = se2.adjoint(step.delta)
        back = Increment(se2.inverse(step.delta), carried @ step.covariance @ carried.T, step.duration, step.still)
        return replace(row.factor, offset=back)
