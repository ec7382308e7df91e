"""Localization from images alone, for an unknown or wrong start and a kidnapped robot.

An image with enough inliers gives the pose by itself; otherwise several images must agree along the odometry. A track is
suspicious if points of the map are persistently not found where they are predicted. If the start position is known, an image must
agree with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.sensors.camera.sensor import KnownPoints, Pixels
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.vision.relocalization import FoundOnFloor
from factors import positive, se2
from factors.motion import ChainState, propagate
from factors.se2 import Array

MISSED = "points in images were not where they were expected"  # why a track is lost
CLEAR, CLEAR_SHARE = 8, 0.5  # minimum number and share of inliers for a single image to be accepted
AGREEING = 3  # images that must agree otherwise
KEPT = 5.0  # s
APART = 25.0  # squared Mahalanobis distance above which two poses disagree
LEAST = np.diag((0.05, 0.05, 0.03)) ** 2  # m, m, rad: lower bound of the covariance
POOR_FRAMES, POOR_TIME = 3, 0.3  # images, and s, with missing points before a track is suspicious
SEARCH_INTERVAL = 1.0  # s between unsuccessful searches


@dataclass(frozen=True)
class _Fix:
    """A pose (3,) with body-frame ``covariance`` (3, 3) from one image."""

    odometry: ChainState
    pose: Array
    covariance: Array
    clear: bool


class PixelFinder:
    """Finds poses from images; see the module."""

    at_once = True

    def __init__(self, points: KnownPoints, motion: Motion) -> None:
        self._points, self._motion = points, motion
        self.start: KnownPosition | None = None  # known start position while the heading is sought
        self._fixes: list[_Fix] = []
        self._stamps: list[tuple[float, bool]] = []
        self._fruitless = -np.inf

    @property
    def newest(self) -> ChainState | None:
        """The odometry state at the last image that gave a pose, or None."""
        return self._fixes[-1].odometry if self._fixes else None

    @property
    def hypotheses(self) -> tuple[Mode, ...]:
        """The poses of the last image."""
        if not self._fixes:
            return ()
        last = self._fixes[-1]
        return (Mode(1.0, last.pose, se2.body_to_world(last.pose, last.covariance)),)

    @property
    def best(self) -> PosePrior | None:
        """The pose at the last image, if it is unambiguous or other images agree."""
        if not self._fixes or not (self._fixes[-1].clear or self._agree()):
            return None
        last = self._fixes[-1]
        return PosePrior(last.odometry.t, last.pose, se2.body_to_world(last.pose, last.covariance))

    def _suspicious_since(self) -> float | None:
        """The time since which points are not where they are predicted, or None."""
        poor: list[float] = []
        for t, missed in reversed(self._stamps):
            if not missed:
                break
            poor.append(t)
        enough = len(poor) >= POOR_FRAMES and poor[0] - poor[-1] >= POOR_TIME
        return poor[-1] if enough else None

    def follow(self, observation: object, odometry: ChainState, view: object) -> None:
        """Nothing to record: missing points tell whether the track is lost."""

    def refuted_since(self, m: Pixels, odometry: ChainState, pose: Array, covariance: Array) -> float | None:
        """The time since which the track must have been wrong, after an image was processed at its ``pose`` (3,): points have
        been missing since then, and the last images agree on another pose. None if they do not.

        The track's covariance is not used, because an uncertain track misses points by searching in the wrong place. Earlier
        results from after that time are discarded.
        """
        self._stamps = [s for s in self._stamps if s[0] < m.t]
        self._stamps.append((m.t, self._points.missed))
        if not self._points.missed:
            self._stamps = self._stamps[-1:]
        since = self._suspicious_since()
        if since is None or not self.look(m, odometry):
            return None
        if _distance(pose, np.zeros((3, 3)), self._fixes[-1]) <= APART:
            self.clear()
            return None
        return since if self._agree() else None

    def look(self, m: Pixels, odometry: ChainState) -> bool:
        """Find the pose from an image alone; False if that fails."""
        if not self._fixes and m.t < self._fruitless + SEARCH_INTERVAL and m.t >= self._fruitless:
            return False
        self._fixes = [f for f in self._fixes if m.t - KEPT <= f.odometry.t < m.t]
        found, seen = self._points.find(m)
        if found is None:
            self._fruitless = m.t
            return False
        if self.start is not None and self._is_not_from(self.start, found, odometry):
            self._fruitless = m.t
            return False
        count = int(np.count_nonzero(found.inliers))
        clear = count >= CLEAR and count >= CLEAR_SHARE * seen
        self._fixes.append(_Fix(odometry, found.pose, found.covariance, clear))
        return True

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Poses (N, 3) sampled from the last image's result."""
        last = self._fixes[-1]
        body = last.covariance + LEAST
        return np.asarray(se2.compose(last.pose, se2.exp(rng.multivariate_normal(np.zeros(3), body, count))))

    def clear(self) -> None:
        """Forget the images: a new track starts, or the current one is trusted."""
        self._fixes, self._stamps = [], []

    @staticmethod
    def _is_not_from(start: KnownPosition, found: FoundOnFloor, now: ChainState) -> bool:
        return bool(2.0 * start.loss(found.pose[None], now, found.covariance + LEAST)[0] > APART)

    def _agree(self) -> bool:
        """Whether the last images agree along the odometry."""
        if len(self._fixes) < AGREEING:
            return False
        *others, last = self._fixes[-AGREEING:]
        for fix in others:
            moved = self._motion.relative(fix.odometry, last.odometry)
            if _distance(se2.compose(fix.pose, moved.delta), propagate(fix.covariance, moved), last) > APART:
                return False
        return True


def _distance(pose: Array, covariance: Array, fix: _Fix) -> float:
    """Squared Mahalanobis distance of a pose from an image to a pose (3,) with body-frame covariance (3, 3)."""
    error = se2.log(se2.between(pose, fix.pose))
    return float(error @ positive.solve(covariance + fix.covariance + LEAST, error[:, None])[:, 0])
