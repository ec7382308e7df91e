"""Where the robot is from what a camera sees alone: for an unknown start, a wrong one, and after being carried elsewhere.

A frame that shows enough of the map tells the pose by itself. One that tells it less clearly needs others to agree with it along
the odometry, and so do those that are to refute a track, which is under suspicion once points of the map are persistently not
where they are expected. Where the start is known but for its heading, a frame must agree with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.model.motion import Motion
from factorgraph_loc.sensors.camera.sensor import KnownPoints, Pixels
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.vision.relocalization import FoundOnFloor
from factors import positive, se2
from factors.motion import ChainState, propagate
from factors.se2 import Array

MISSED = "points in images were not where they were expected"  # why a track is lost
CLEAR, CLEAR_SHARE = 8, 0.5  # points that agree, and their share, for a frame to be believed by itself
AGREEING = 3  # frames, otherwise
KEPT = 5.0  # s
APART = 25.0  # squared Mahalanobis distance, beyond which two poses are different places
LEAST = np.diag((0.05, 0.05, 0.03)) ** 2  # m, m, rad: closer poses are the same place
POOR_FRAMES, POOR_TIME = 3, 0.3  # frames, and s, in which points must be missed for a suspicion
SEARCH_INTERVAL = 1.0  # s between searches that find nothing


@dataclass(frozen=True)
class _Fix:
    """A pose (3,) with body-frame ``covariance`` (3, 3) from one frame."""

    odometry: ChainState
    pose: Array
    covariance: Array
    clear: bool


class PixelFinder:
    """Poses from frames; see the module."""

    at_once = True

    def __init__(self, points: KnownPoints, motion: Motion) -> None:
        self._points, self._motion = points, motion
        self.start: KnownPosition | None = None  # where the robot began, while its heading is sought
        self._fixes: list[_Fix] = []
        self._stamps: list[tuple[float, bool]] = []
        self._fruitless = -np.inf

    @property
    def newest(self) -> ChainState | None:
        """The odometry at the last frame that told a pose; None if none did."""
        return self._fixes[-1].odometry if self._fixes else None

    @property
    def hypotheses(self) -> tuple[Mode, ...]:
        """What the last frame told."""
        if not self._fixes:
            return ()
        last = self._fixes[-1]
        return (Mode(1.0, last.pose, se2.body_to_world(last.pose, last.covariance)),)

    @property
    def best(self) -> PosePrior | None:
        """The pose at the last frame, if it is clear or others agree."""
        if not self._fixes or not (self._fixes[-1].clear or self._agree()):
            return None
        last = self._fixes[-1]
        return PosePrior(last.odometry.t, last.pose, se2.body_to_world(last.pose, last.covariance))

    def _suspicious_since(self) -> float | None:
        """When the points began not to be where they are expected, None if all is well."""
        poor: list[float] = []
        for t, missed in reversed(self._stamps):
            if not missed:
                break
            poor.append(t)
        enough = len(poor) >= POOR_FRAMES and poor[0] - poor[-1] >= POOR_TIME
        return poor[-1] if enough else None

    def follow(self, observation: object, odometry: ChainState, view: object) -> None:
        """Nothing: what is missed in an image tells whether a track is lost."""

    def refuted_since(self, m: Pixels, odometry: ChainState, pose: Array, covariance: Array) -> float | None:
        """Since when a track must have been wrong, after a frame was taken at its ``pose`` (3,): points were missed since then, and
        the last frames agree on another place. None where they do not.

        How sure the track is does not count: the points of one that is not are missed as they are looked for in wrong places.
        Frames from that time on that were taken before are forgotten.
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
        """Find the pose from a frame alone; False where it tells none."""
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
        """Poses (N, 3) drawn from what the last frame told."""
        last = self._fixes[-1]
        body = last.covariance + LEAST
        return np.asarray(se2.compose(last.pose, se2.exp(rng.multivariate_normal(np.zeros(3), body, count))))

    def clear(self) -> None:
        """Forget the frames: the track begins anew, or is trusted."""
        self._fixes, self._stamps = [], []

    @staticmethod
    def _is_not_from(start: KnownPosition, found: FoundOnFloor, now: ChainState) -> bool:
        return bool(2.0 * start.loss(found.pose[None], now, found.covariance + LEAST)[0] > APART)

    def _agree(self) -> bool:
        """Whether the last frames agree, along the odometry."""
        if len(self._fixes) < AGREEING:
            return False
        *others, last = self._fixes[-AGREEING:]
        for fix in others:
            moved = self._motion.relative(fix.odometry, last.odometry)
            if _distance(se2.compose(fix.pose, moved.delta), propagate(fix.covariance, moved), last) > APART:
                return False
        return True


def _distance(pose: Array, covariance: Array, fix: _Fix) -> float:
    """Squared Mahalanobis distance of a fix from a pose (3,) with body-frame covariance (3, 3)."""
    error = se2.log(se2.between(pose, fix.pose))
    return float(error @ positive.solve(covariance + fix.covariance + LEAST, error[:, None])[:, 0])
