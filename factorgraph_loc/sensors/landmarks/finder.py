"""Global localization from identified landmarks alone, and detection of a wrong estimated pose.

The odometry relates the sightings of the last minute to the present pose. Candidate poses are generated from few
sightings: one landmark gives a circle around it, two landmarks give the alignment of two points. All sightings score
each candidate by the robust likelihood. The best candidates are refined by Levenberg-Marquardt. Those that remain
distinct are the hypotheses of the pose.

The weight of a hypothesis is its posterior probability by Laplace's method: the likelihood times the volume of the mode
(MacKay, "Information Theory, Inference, and Learning Algorithms", 2003, eq. 27.6). The prior is flat, or the prior of a
known start position. Source of hypotheses that are generated from few features and tested with the others: Jensfelt,
Kristensen, IEEE Transactions on Robotics and Automation 17(5), 2001.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.sensors.base import View
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factorgraph_loc.sensors.landmarks.window import Sighting, SightingWindow
from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.landmarks.factor import BearingRangeFactor
from factors.landmarks.model import HEIGHT, BearingRangeModel, on_floor
from factors.motion import ChainState
from factors.robust import geman_mcclure_loss
from factors.se2 import Array
from factors.update import GATE

DURATION = 60.0  # s; older sightings are not used
INTERVAL = 1.0  # s; minimum time between the sightings of one landmark, because errors at nearly equal times are equal
ROWS = 60  # maximum number of sightings in a search
REFINED = 24  # maximum number of candidates that are refined
# squared Mahalanobis distances: hypotheses closer than SAME are merged; a refinement by more than DIVERGED is rejected
SAME, DIVERGED = 9.0, 25.0
NEGLIGIBLE = 1e-3  # hypotheses with a smaller weight are discarded
MARGIN = 5.0  # m; maximum distance of the robot from the bounding box of the landmarks
WIDE = 3.0  # m; a hypothesis with a larger standard deviation is not treated as Gaussian
# the estimated pose is rejected if a hypothesis explains this many landmarks and this fraction of the sightings, and if
# its robust loss is lower than that of the estimated pose by this fraction of the maximum loss
REFUTING_LANDMARKS, REFUTING_SHARE, REFUTED = 3, 0.8, 0.5

# minimum weight and number of explained sightings of an unambiguous hypothesis, and its maximum standard deviations
# [m, rad]; the limit of the position is at least the standard deviation of a range
CLEAR_WEIGHT, CLEAR_SIGHTINGS = 0.99, 4
CLEAR_POSITION, CLEAR_HEADING = 0.3, 0.15
FOUND_HEADING = 0.3  # rad; replaces CLEAR_HEADING if the start position is known
STAMPS, MONITORED = 4, 2.0  # minimum number of timestamps, and their minimum time span [s], to judge the estimated pose
KEPT = 100  # number of stored timestamps
BEYOND = 2.0  # a landmark contradicts the estimated pose if its squared innovation exceeds BEYOND * GATE
SHARE = 0.6  # the estimated pose is suspicious if a larger fraction of landmarks contradicts it
SEARCH_INTERVAL = 1.0  # s between searches while the estimated pose is suspicious


@dataclass(frozen=True)
class Hypothesis(Mode):
    """A possible pose of the robot, as a Gaussian. Its ``weight`` is its posterior probability.

    ``explained``: the number of sightings that are inliers at this pose. ``share``: the fraction of sightings that are
    inliers. ``landmarks``: the number of different landmarks among the inliers.
    """

    explained: int
    share: float
    landmarks: int


class LandmarkFinder:
    """Global localization by landmarks of the map. It implements :class:`~factorgraph_loc.sensors.base.Finder`.

    ``factor``: a function that returns the factor of the mapped landmarks in a measurement, or None if there are none.
    ``positions`` (L, 2): the positions of the landmarks in the map. ``hypotheses``: the result of :meth:`search`, most
    likely first. ``best``: the pose at the last sighting if it is unambiguous, otherwise None.
    """

    at_once = False

    def __init__(
        self, factor: Callable[[BearingRange], BearingRangeFactor | None], motion: Motion, positions: Array
    ) -> None:
        self._factor, self._motion = factor, motion
        extent = np.ptp(positions, axis=0) if len(positions) else np.zeros(2)
        self._log_volume = math.log(2.0 * math.pi * np.prod(extent + 2.0 * MARGIN))
        self._model = BearingRangeModel()
        self._sightings: dict[tuple[float, float], list[Sighting]] = {}
        self._window: SightingWindow | None = None
        self._monitor = TrackMonitor()
        self.hypotheses: tuple[Hypothesis, ...] = ()
        self.best: PosePrior | None = None
        self.start: KnownPosition | None = None
        self.newest: ChainState | None = None

    @property
    def suspicious_since(self) -> float | None:
        """The time [s] since which most landmarks contradict the estimated pose, or None if most agree with it."""
        return self._monitor.suspicious_since

    def look(self, m: BearingRange, odometry: ChainState) -> bool:
        factor = self._factor(m)
        if factor is None:
            return False
        self.add(odometry, factor)
        self.search()
        self.newest = odometry
        return True

    def follow(self, observation: Any, odometry: ChainState, view: View) -> None:
        factor = observation.on_pose({name: np.asarray(view.value(name)) for name in observation.blocks}, {}).measured
        self.add(odometry, factor)
        self._monitor.add(observation.t, factor, view.pose, view.covariance)

    def refuted_since(self, m: BearingRange, odometry: ChainState, pose: Array, covariance: Array) -> float | None:
        since = self._monitor.suspicious_since
        if since is None or (self.newest is not None and odometry.t < self.newest.t + SEARCH_INTERVAL):
            return None
        self.forget(since)
        self.search()
        self.newest = odometry
        return since if self.refutes(pose, covariance) else None

    def clear(self) -> None:
        self._monitor.clear()

    def add(self, odometry: ChainState, factor: BearingRangeFactor) -> None:
        """Store the sightings in ``factor``. ``odometry``: the odometry state at their time."""
        self._model = factor.model
        points, ranges = factor.points[:, :HEIGHT], on_floor(factor.model, factor.points, factor.ranges)
        places, values = points.tolist(), zip(ranges.tolist(), factor.bearings.tolist(), strict=True)
        for point, (x, y), (distance, bearing) in zip(points, places, values, strict=True):
            _insert(self._sightings.setdefault((x, y), []), Sighting(odometry, point, distance, bearing))
        self.forget(odometry.t - DURATION)

    def forget(self, oldest: float) -> None:
        """Delete the sightings before the time ``oldest`` [s]."""
        old = [(key, rows) for key, rows in self._sightings.items() if rows[0].odometry.t < oldest]
        for key, rows in old:
            del rows[: bisect.bisect_left(rows, oldest, key=_time)]
            if not rows:
                del self._sightings[key]

    def search(self) -> None:
        """Set ``hypotheses`` and ``best``, the possible poses at the last sighting, from all stored sightings."""
        rows = sorted((r for rows in self._sightings.values() for r in rows), key=lambda r: r.odometry.t)[-ROWS:]
        earlier, previous = self.hypotheses, self._window
        self.hypotheses, self.best, self._window = (), None, None
        if not rows:
            return
        window = self._window = SightingWindow(self._model, rows, self._motion, self.start)
        poses = np.concatenate((window.starts(), window.alignments(), window.circles()))
        if previous is not None and earlier:
            since = self._motion.relative(previous.now, window.now).delta
            poses = np.concatenate((se2.compose(np.array([h.pose for h in earlier]), since), poses))
        grain = window.candidate_covariance()
        coarse, fine = window.whitener(grain), window.whitener()
        losses = window.losses(poses, coarse, grain)
        poses = poses[_distinct_poses(poses, losses, np.sqrt(np.diag(grain)), REFINED)]
        poses, _ = window.refined(poses, coarse, iterations=4, noise=grain)
        poses, covariances = window.refined(poses, fine, iterations=6)
        squared = window.squared(poses, fine)
        logs = -geman_mcclure_loss(squared, self._model.robust).sum(axis=1) + self._log_prior(
            window, poses, covariances
        )
        self.hypotheses = self._with_probabilities(window, poses, covariances, squared, logs)
        self.best = self._unambiguous(window)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` random poses (N, 3) at the last sighting, or (0, 3) before the first sighting.

        Samples are drawn from hypotheses with small covariances, in proportion to their weights. The remaining samples
        are drawn from the likelihood of the last sighting (sensor resetting: Lenser, Veloso, ICRA 2000).
        """
        if self._window is None:
            return np.empty((0, 3))
        narrow = [h for h in self.hypotheses if np.linalg.eigvalsh(h.covariance[:2, :2])[-1] < WIDE**2]
        weights = np.array([h.weight for h in narrow])
        counts = rng.multinomial(count, np.append(weights, max(0.0, 1.0 - weights.sum())))
        poses = [self._window.drawn(rng, int(counts[-1]))]
        for h, n in zip(narrow, counts, strict=False):
            body = se2.world_to_body(h.pose, h.covariance)
            poses.append(se2.compose(h.pose, se2.exp(rng.multivariate_normal(np.zeros(3), body, int(n)))))
        return np.concatenate(poses)

    def refutes(self, pose: Array, covariance: Array) -> bool:
        """Return True if the estimated pose is wrong, because ``best`` explains nearly all sightings, and many more
        than this pose. ``pose`` (3,) with body-frame ``covariance`` (3, 3): the estimate at the last sighting."""
        if self.best is None or self._window is None:
            return False
        if self.hypotheses[0].share < REFUTING_SHARE or self.hypotheses[0].landmarks < REFUTING_LANDMARKS:
            return False
        window, scale = self._window, self._model.robust
        track = geman_mcclure_loss(window.squared(pose[None], window.whitener(covariance)), scale).sum()
        best = geman_mcclure_loss(window.squared(self.best.pose[None], window.whitener()), scale).sum()
        return bool(track - best > REFUTED * 0.5 * scale**2 * len(window.points))

    def _log_prior(self, window: SightingWindow, poses: Array, covariances: Array) -> Array:
        """Return the logarithm (N,) of the prior probability of N Gaussian modes: the prior density times the volume.
        ``window``: the sightings. ``poses`` (N, 3), ``covariances`` (N, 3, 3): means and body-frame covariances of the
        modes."""
        volume: Array = 0.5 * np.linalg.slogdet(2.0 * math.pi * covariances)[1]
        density = -self._log_volume if self.start is None else self.start.log_density(poses, window.now)
        return np.asarray(np.minimum(volume + density, 0.0))

    def _with_probabilities(
        self, window: SightingWindow, poses: Array, covariances: Array, squared: Array, logs: Array
    ) -> tuple[Hypothesis, ...]:
        """Return the distinct hypotheses with posterior probabilities, most likely first.

        ``poses`` (N, 3), ``covariances`` (N, 3, 3): means and body-frame covariances. ``squared`` (N, K): squared
        residuals of K sightings. ``logs`` (N,): logarithms of the unnormalised probabilities. The probability that all
        sightings are outliers is part of the normalisation.
        """
        covariances = se2.body_to_world(poses, covariances)
        kept: list[int] = []
        for i in np.argsort(-logs):
            if all(_distance(poses[i], poses[k], covariances[k]) > SAME for k in kept):
                kept.append(int(i))
        logs = np.append(logs[kept], -0.5 * self._model.robust**2 * squared.shape[1])
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        inside = squared < GATE
        return tuple(
            Hypothesis(
                weight=float(weight),
                pose=poses[i],
                covariance=covariances[i],
                explained=int(inside[i].sum()),
                share=float(inside[i].mean()),
                landmarks=len(np.unique(window.points[inside[i]], axis=0)),
            )
            for i, weight in zip(kept, weights, strict=False)
            if weight > NEGLIGIBLE
        )

    def _unambiguous(self, window: SightingWindow) -> PosePrior | None:
        """Return the most likely hypothesis if it is unambiguous, otherwise None. The returned pose is refined with
        correlated odometry errors. ``window``: the sightings."""
        if not self.hypotheses:
            return None
        best = self.hypotheses[0]
        if best.weight < CLEAR_WEIGHT or best.share <= 0.5:
            return None
        # a single landmark is not enough, unless the start is known, because it may be misidentified
        if best.explained < CLEAR_SIGHTINGS or best.landmarks < (2 if self.start is None else 1):
            return None
        pose, covariance = window.fused(best.pose, window.whitener(), iterations=8)
        covariance = se2.body_to_world(pose, covariance)
        if _distance(pose, best.pose, best.covariance + covariance) > DIVERGED:
            return None
        position = max(CLEAR_POSITION, self._model.range_sigma)
        heading = CLEAR_HEADING if self.start is None else FOUND_HEADING
        if np.linalg.eigvalsh(covariance[:2, :2])[-1] > position**2 or covariance[2, 2] > heading**2:
            return None
        return PosePrior(window.now.t, pose, covariance)


def _time(row: Sighting) -> float:
    return row.odometry.t


def _insert(rows: list[Sighting], row: Sighting) -> None:
    """Insert the sighting ``row`` into ``rows``, the sightings of the same landmark in order of time. Sightings less
    than INTERVAL [s] after the previous one are removed, except the last one."""
    if rows and row.odometry.t <= rows[-1].odometry.t:
        rows[:] = [r for r in rows if r.odometry.t != row.odometry.t]
        rows.append(row)
        rows.sort(key=_time)
        rows[:] = _thinned(rows)
        return
    # only the last two rows may be closer than INTERVAL
    if len(rows) > 1 and rows[-1].odometry.t < rows[-2].odometry.t + INTERVAL:
        rows.pop()
    rows.append(row)


def _thinned(rows: list[Sighting]) -> list[Sighting]:
    """Return those sightings of a landmark that are at least INTERVAL apart in time, and the last sighting."""
    kept = rows[:1]
    for row in rows[1:]:
        if row.odometry.t >= kept[-1].odometry.t + INTERVAL:
            kept.append(row)
    return kept if kept[-1] is rows[-1] else [*kept, rows[-1]]


def _distinct_poses(poses: Array, losses: Array, apart: Array, count: int) -> NDArray[np.int64]:
    """Return the indices of at most ``count`` distinct poses with the lowest losses. ``poses`` (N, 3), ``losses`` (N,):
    all poses. ``apart`` (3,): two poses are distinct if they differ by at least this in one component."""
    kept: list[int] = []
    losses = losses.copy()
    while len(kept) < count and np.isfinite(losses).any():
        kept.append(int(np.argmin(losses)))
        difference = poses - poses[kept[-1]]
        difference[:, 2] = se2.wrap(difference[:, 2])
        losses[np.all(np.abs(difference) < apart, axis=1)] = np.inf
    return np.array(kept, dtype=np.int64)


def _distance(pose: Array, mean: Array, covariance: Array) -> float:
    """Return the squared Mahalanobis distance between two poses (3,), with ``covariance`` (3, 3) in the world frame."""
    difference = pose - mean
    difference[2] = se2.wrap_scalar(difference[2])
    return float(positive.squared(difference, covariance))


class TrackMonitor:
    """Detects that most of the last sightings contradict the estimated pose, because the pose or the map is wrong.
    ``suspicious_since``: the time [s] since which the sightings contradict the pose, or None."""

    def __init__(self) -> None:
        self._stamps: list[tuple[float, int, int]] = []
        self.suspicious_since: float | None = None

    def add(self, t: float, factor: BearingRangeFactor, pose: Array, covariance: Array) -> None:
        """Count the landmarks of ``factor`` that contradict ``pose``, and update ``suspicious_since``. ``t``: the time
        [s]. ``pose`` (3,) with body-frame ``covariance`` (3, 3): the estimate before the measurement corrects it."""
        beyond = factor.count_beyond(BEYOND * GATE, pose, covariance)
        while self._stamps and self._stamps[-1][0] >= t:
            self._stamps.pop()
        del self._stamps[:-KEPT]
        self._stamps.append((t, beyond, len(factor.points)))
        counts = tuple(zip(*self._last(), strict=True))
        share = sum(counts[1]) / max(1, sum(counts[2])) if counts else 0.0
        lasts = share > SHARE or (self.suspicious_since is not None and share >= SHARE / 2.0)
        self.suspicious_since = self._beginning() if lasts else None

    def clear(self) -> None:
        """Discard all counts. Call this if the estimated pose was replaced or confirmed."""
        self._stamps.clear()
        self.suspicious_since = None

    def _beginning(self) -> float:
        """Return the time [s] since which most landmarks contradict the pose. This time best separates agreeing
        landmarks from later contradicting landmarks."""
        excess = np.array([2 * beyond - count for _, beyond, count in self._stamps])
        return self._stamps[int(np.argmax(np.cumsum(excess[::-1])[::-1]))][0]

    def _last(self) -> list[tuple[float, int, int]]:
        """Return the counts of the last timestamps, as few as suffice to judge the pose, or [] if there are too few. A
        count is (time [s], number of contradicting landmarks, number of all landmarks)."""
        for i in range(len(self._stamps) - STAMPS, -1, -1):
            if self._stamps[i][0] <= self._stamps[-1][0] - MONITORED:
                return self._stamps[i:]
        return []
