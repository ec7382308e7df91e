"""Localization from measured positions alone, at an unknown start or after a kidnapping.

The positions of the last minute are aligned with the path of the odometry. The heading is known once the robot has travelled far
enough. A track is given up if all positions of some time contradict it and agree on another pose.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.sensors.base import View
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.motion import ChainState
from factors.positions.factor import PositionFactor
from factors.robust import geman_mcclure_weight
from factors.se2 import Array
from factors.update import GATE

DURATION, INTERVAL = 60.0, 0.5  # s: of the positions that are aligned, and between them
FEWEST, SHARE = 5, 0.8  # minimum number of positions of a pose, and share of them within the gate
HEADING = 0.15  # rad; largest standard deviation of a known heading
WIDENINGS = (64.0, 16.0, 4.0, 1.0, 1.0, 1.0)  # of the loss, by iteration
BEYOND = 2.0  # times the gate
CONTRADICTED = 10.0  # s of positions beyond it, after which the track is doubted: a wrong fix may last some seconds
SEARCH_INTERVAL = 1.0  # s between alignments while the track is doubted


class Row(NamedTuple):
    """A position (2,) with ``covariance`` (2, 2) of the point ``arm`` (2,) of the robot at ``odometry``."""

    odometry: ChainState
    position: Array
    covariance: Array
    arm: Array


class PositionFinder:
    """A :class:`~factorgraph_loc.sensors.base.Finder`; see the module. ``observation``: of a measurement, at its time."""

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
        """The time since which all positions contradict the track."""
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
        """Poses (N, 3) at the last position; with any heading as long as that is unknown."""
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
        """Add a position; late ones are skipped, and close ones replaced by the last."""
        self._robust = factor.robust
        if self._rows and odometry.t <= self._rows[-1].odometry.t:
            return
        if len(self._rows) > 1 and self._rows[-1].odometry.t < self._rows[-2].odometry.t + INTERVAL:
            self._rows.pop()
        self._rows.append(Row(odometry, factor.position, factor.covariance, factor.arm))
        while self._rows[0].odometry.t < odometry.t - DURATION:
            self._rows.popleft()

    def _align(self, now: ChainState) -> None:
        """Estimate the pose ``now`` by aligning the path with the positions, by least squares with a loss that narrows."""
        rows = list(self._rows)
        if self.start is not None:
            known = self.start.prior
            rows.insert(0, Row(self.start.odometry, known.pose[:2], known.covariance[:2, :2], np.zeros(2)))
        moved = [self._motion.relative(row.odometry, now) for row in rows]
        # the measured points in the present robot frame
        points = np.array(
            [se2.transform_from(se2.inverse(step.delta), row.arm) for step, row in zip(moved, rows, strict=True)]
        )
        drift = np.array([step.covariance for step in moved])
        pose = _rigid(points, np.array([row.position for row in rows]))
        for widening in WIDENINGS:
            residual, jacobian = _linearized(pose, points, drift, rows)
            squared = np.einsum("ni,ni->n", residual, residual)
            weight = geman_mcclure_weight(squared, widening * self._robust)
            information = np.einsum("nij,n,nik->jk", jacobian, weight, jacobian) + 1e-9 * np.eye(3)
            gradient = np.einsum("nij,n,ni->j", jacobian, weight, residual)
            pose = se2.compose(pose, se2.exp(-np.linalg.solve(information, gradient)))
        covariance = se2.body_to_world(pose, np.linalg.inv(information))
        is_known = len(rows) > 1 and covariance[2, 2] < 1.0
        if not is_known:
            covariance = np.diag((*np.diag(rows[-1].covariance), math.pi**2 / 3.0))
            pose = np.array((*rows[-1].position, 0.0))
        self.hypotheses = (Mode(1.0, pose, covariance),)
        agree = is_known and len(rows) >= FEWEST and float(np.mean(squared < GATE)) >= SHARE
        self.best = PosePrior(now.t, pose, covariance) if agree and covariance[2, 2] < HEADING**2 else None


def _rigid(points: Array, positions: Array) -> Array:
    """The pose (3,) that maps ``points`` (N, 2) to ``positions`` (N, 2) best (Umeyama, PAMI 13(4), 1991, in the plane)."""
    p, q = points - points.mean(axis=0), positions - positions.mean(axis=0)
    heading = math.atan2(float(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])), float(np.sum(p * q)))
    origin = positions.mean(axis=0) - se2.transform_from(np.array((0.0, 0.0, heading)), points.mean(axis=0))
    return np.append(origin, heading)


def _linearized(pose: Array, points: Array, drift: Array, rows: Sequence[Row]) -> tuple[Array, Array]:
    """Whitened errors (N, 2) of the positions and their Jacobians (N, 2, 3) by the pose. ``drift`` (N, 3, 3): covariances of the
    motion from each row."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    lever = np.zeros((len(points), 2, 3))
    lever[:, 0, 0] = lever[:, 1, 1] = 1.0
    lever[:, 0, 2], lever[:, 1, 2] = -points[:, 1], points[:, 0]
    jacobian = np.array(((c, -s), (s, c))) @ lever
    noise = np.array([row.covariance for row in rows]) + jacobian @ drift @ jacobian.transpose(0, 2, 1)
    whitener = positive.whitener(noise)
    errors = se2.transform_from(pose, points) - np.array([row.position for row in rows])
    return np.einsum("nij,nj->ni", whitener, errors), whitener @ jacobian
