"""The camera sensor of a run, and localization from images alone.

The sensor observes points of the map, which are identified by name or by appearance. At an unknown start, or after a
kidnapping, one image with enough inliers determines the pose. Otherwise the poses from several images must agree, after
the odometry moved them to the same time. An image must also agree with the start position if that is known. A track is
suspicious if several consecutive images do not show the points of the map at their predicted positions.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.model.measurement import GOING_BACK
from factorgraph_loc.model.settings import NOTHING, Estimated
from factorgraph_loc.sensors.base import Binding, Blocks, Columns, NewVariable, ResidualObservation, Sensor, Term, View
from factorgraph_loc.sensors.camera.known_points import ITERATIONS, SETTLED, KnownPoints, Predicted
from factorgraph_loc.sensors.camera.measurement import CAMERAS, Pixels
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.vision.relocalization import FoundOnFloor
from factors import positive, se2
from factors.camera import model as reprojection
from factors.camera.factor import ReprojectionFactor, image_update
from factors.camera.model import TIME_OFFSET, TiltScale
from factors.motion import ChainState, propagate
from factors.se2 import Array
from factors.update import Correction

PASS = 10.0  # s; sightings of a point within this time have the same survey error, so their noise is enlarged
SOLVE_EVERY = 0.45  # s between updates of a graph's solver; other images only update the newest pose, as in a filter


@dataclass(frozen=True)
class PixelObservation(ResidualObservation):
    """The observation of points in one image.

    ``seen``: the factor of the points. It depends on the pose, and possibly on constants of the camera and
    displacements of points. ``expected`` (3,): the pose that was predicted when the points were identified.
    ``held``: estimates (P,) and covariance (P, P) of the camera's constants if the observation depends on the pose only.
    """

    iterations: ClassVar[int] = ITERATIONS
    settled: ClassVar[float] = SETTLED
    seen: ReprojectionFactor
    expected: Array = field(default_factory=lambda: np.zeros(3))
    held: tuple[Array, Array] | None = None

    @classmethod
    def of(cls, t: float, seen: ReprojectionFactor, blocks: tuple[str, ...], expected: Array) -> Self:
        """Return the observation of a factor ``seen`` on the pose and on ``blocks``. ``expected`` (3,): predicted pose."""
        return cls(t, (Term(seen, blocks, seen.dof()),), seen, expected)

    def correct(
        self, pose: Array, covariance: Array, values: Blocks, columns: Columns, iterations: int = ITERATIONS
    ) -> Correction:
        if self.held is not None:
            size = 3 + len(self.held[0])
            both = np.zeros((size, size))
            both[:3, :3], both[3:, 3:] = covariance, self.held[1]
            update = image_update(self.seen, pose, both, iterations, self.settled, self.held[:1], (slice(3, size),))
            return replace(update, delta=update.delta[:3], covariance=update.covariance[:3, :3])
        at, places = [values[name] for name in self.blocks], [columns[name] for name in self.blocks]
        return image_update(self.seen, pose, covariance, iterations, self.settled, at, places)

    def log_likelihood(self, poses: Array, values: Blocks) -> Array:
        factor, covariances = self.seen, None
        _, by_pose, by_point, by_constants = reprojection.linearize(factor.model, self.expected, factor.points)
        tilts = reprojection.by_tilt(factor.model, by_constants)
        if factor.point_covariances is not None or self.held is not None:
            covariances = np.broadcast_to(factor.model.sigma**2 * np.eye(2), (len(by_point), 2, 2))
            if factor.point_covariances is not None:
                covariances = covariances + by_point @ factor.point_covariances @ by_point.transpose(0, 2, 1)
            if self.held is not None:
                if factor.twist is not None:
                    by_constants[..., TIME_OFFSET] = by_pose @ factor.twist
                by_constants = by_constants[..., list(factor.estimated)]
                # the error of the constants is common to all pixels, so it must not average out
                common = by_constants @ self.held[1] @ by_constants.transpose(0, 2, 1)
                covariances = covariances + len(common) * common
        return reprojection.log_likelihood(factor.model, poses, factor.points, factor.pixels, tilts, covariances)

    def on_pose(self, values: Blocks, spreads: Blocks) -> Self:
        """Return the observation as a function of the pose only. The camera's constants and displacements of points are
        fixed at ``values``, and their covariances ``spreads`` are added to the noise."""
        if not self.blocks:
            return self
        seen, held, blocks = self.seen, None, self.blocks
        if seen.estimated:
            held, blocks = (values[blocks[0]], spreads[blocks[0]]), blocks[1:]
        if seen.moved_by:
            assert seen.point_covariances is not None
            points, noise = seen.points.copy(), seen.point_covariances.copy()
            for row, which in enumerate(seen.moved_by):
                if which >= 0:  # points with a common displacement have the same error, so it must not average out
                    points[row] += values[blocks[which]]
                    noise[row] = seen.moved_by.count(which) * spreads[blocks[which]]
            seen = replace(seen, points=points, point_covariances=noise, moved_by=())
        return replace(self, terms=(Term(seen, (), seen.dof()),), seen=seen, held=held)


class CameraSensor(Sensor):
    """A camera that observes points of the map. ``points``: identifies points and rejects outliers."""

    modality = "camera"
    lost = "points in images were not where they were expected"
    follows_constants = True  # matching depends on the estimated constants

    def __init__(self, binding: Binding, constants: Estimated) -> None:
        super().__init__(binding.name)
        motion, self._diagnostics = binding.motion, binding.diagnostics
        self._uncertain, self._motion = constants, motion
        self.constants = constants if binding.calibration == "all" else NOTHING
        self._carries = binding.calibration != "particles"  # particles cannot estimate displacements of points
        self.points = KnownPoints(binding.setup, self._diagnostics, constants, binding.points, self.name)
        # times [s] of recent sightings of each inexactly surveyed point or marker whose displacement is not estimated
        self._looks: dict[str, list[float]] = defaultdict(list)
        self._before: deque[tuple[float, TiltScale]] = deque()  # the learnt tilt before each image
        self._shared = (self.name,) if constants.names else ()
        if len(self.points.map):
            self.finder = PixelFinder(self.points, motion)
            # pixels of known points determine the pose well, so a graph is not solved for each image, unless the camera's
            # mounting is estimated
            self.solve_every = 0.0 if constants.names else SOLVE_EVERY

    def observe(self, m: Pixels, view: View) -> Iterator[PixelObservation | NewVariable]:
        twist = self._motion.twist(m.t) if self.points.needs_twist else None
        predicted, values, spreads = Predicted(view.pose, view.covariance), {}, {}
        for name in self._shared:
            value = view.value(name)
            values[name] = np.zeros(len(self._uncertain.names)) if value is None else value
            spreads[name] = np.diag(self._uncertain.sigmas**2) if value is None else view.block_covariance(name)
            predicted = replace(predicted, constants=values[name], spread=spreads[name])
        displaced, blocks = {}, {}
        for name, (points, survey) in self.points.inexact(m).items():
            block = f"{self.name}/{name}"
            if self._carries and view.value(block) is None:
                yield NewVariable(block, np.zeros(3), np.zeros((3, 3)), {}, survey, ())
            by, spread = view.value(block), survey
            if by is None:
                by, spread = np.zeros(3), self._looks_now(name, m.t) * survey
            else:
                spread = view.block_covariance(block)
                blocks.update(dict.fromkeys(points, block))
            displaced.update(dict.fromkeys(points, (by, len(points) * spread)))
        self._before.append((m.t, self.points.floor))
        while self._before[0][0] < m.t - GOING_BACK:
            self._before.popleft()
        factor = self.points.factor(m, predicted, view.offset, twist, displaced)
        if factor is None:
            return
        names = [blocks.get(name, "") for name in self.points.names]
        moving = tuple(dict.fromkeys(filter(None, names)))
        if moving:
            factor = displaced_by(factor, [moving.index(name) if name else -1 for name in names])
        observation = PixelObservation.of(m.t, factor, (*self._shared, *moving), view.pose)
        yield observation if self.constants.names or moving else observation.on_pose(values, spreads)

    def _looks_now(self, name: str, t: float) -> int:
        """Record a sighting of a point or marker at ``t`` [s]. Returns the number of its sightings within :data:`PASS`
        seconds."""
        times = [*(earlier for earlier in self._looks[name] if earlier > t - PASS), t]
        self._looks[name] = times
        return len(times)

    def rewind(self, t: float) -> None:
        for name, times in self._looks.items():
            self._looks[name] = [earlier for earlier in times if earlier <= t]
        while self._before and self._before[-1][0] > t:
            _, self.points.floor = self._before.pop()

    def restart(self, t: float) -> None:
        self._looks.clear()

    def judge(self, observation: PixelObservation, correction: Correction, view: View) -> bool:
        self._diagnostics.innovation(self.name, observation.t, correction.nis, correction.dof)
        u, v = (-observation.seen.model.sigma * correction.residual.T).tolist()
        self._diagnostics.add_residuals(f"{self.name}.u", u)
        self._diagnostics.add_residuals(f"{self.name}.v", v)
        return True


def displaced_by(factor: ReprojectionFactor, which: list[int]) -> ReprojectionFactor:
    """Return a factor that also depends on displacements of points. ``which`` (K): for each point the number of its
    displacement among the values, or -1 for none. A point with a displacement has no survey noise, because the
    displacement accounts for it."""
    covariances = factor.point_covariances
    if covariances is not None:
        covariances = np.where(np.array(which)[:, None, None] < 0, covariances, 0.0)
    return replace(factor, point_covariances=covariances, moved_by=tuple(which))


def bind(binding: Binding) -> CameraSensor | None:
    """Return the camera sensor of a run, or None if the run does not use it. The particle filter does not estimate the
    camera's constants; their uncertainty is added to the noise."""
    setup = binding.setup
    if setup.rig.find(CameraSettings) is None or not any(sensor in setup.sensors for sensor in CAMERAS):
        return None
    return CameraSensor(binding, NOTHING if binding.calibration == "none" else setup.rig.estimated("camera"))


CLEAR, CLEAR_SHARE = 8, 0.5  # a single image is sufficient if it has this number and fraction of inliers
AGREEING = 3  # number of images that must agree if no single image is sufficient
KEPT = 5.0  # s; older images are discarded
APART = 25.0  # two poses disagree if their squared Mahalanobis distance is larger
LEAST = np.diag((0.05, 0.05, 0.03)) ** 2  # m^2, m^2, rad^2; added to covariances of poses by images
POOR_FRAMES, POOR_TIME = 3, 0.3  # number of images and time [s] with missing points that make a track suspicious
SEARCH_INTERVAL = 1.0  # s between unsuccessful searches


@dataclass(frozen=True)
class _Fix:
    """The ``pose`` (3,) of the robot from one image, with body-frame ``covariance`` (3, 3). ``odometry``: the odometry
    state at the image. ``clear``: True if this image alone is sufficient to localize the robot."""

    odometry: ChainState
    pose: Array
    covariance: Array
    clear: bool


class PixelFinder:
    """Finds the pose from images without a prediction. It implements :class:`~factorgraph_loc.sensors.base.Finder`."""

    at_once = True

    def __init__(self, points: KnownPoints, motion: Motion) -> None:
        self._points, self._motion = points, motion
        self.start: KnownPosition | None = None  # known start position while the heading is sought
        self._fixes: list[_Fix] = []
        self._stamps: list[tuple[float, bool]] = []
        self._fruitless = -np.inf

    @property
    def newest(self) -> ChainState | None:
        """The odometry state at the last image with a pose, or None."""
        return self._fixes[-1].odometry if self._fixes else None

    @property
    def hypotheses(self) -> tuple[Mode, ...]:
        """The pose from the last image as the only hypothesis, or () if no image has determined a pose."""
        if not self._fixes:
            return ()
        last = self._fixes[-1]
        return (Mode(1.0, last.pose, se2.body_to_world(last.pose, last.covariance)),)

    @property
    def best(self) -> PosePrior | None:
        """The pose at the last image if it is unambiguous or if other images agree, otherwise None."""
        if not self._fixes or not (self._fixes[-1].clear or self._agree()):
            return None
        last = self._fixes[-1]
        return PosePrior(last.odometry.t, last.pose, se2.body_to_world(last.pose, last.covariance))

    def _suspicious_since(self) -> float | None:
        """Return the time [s] since which images do not show points at their predicted positions, or None."""
        poor: list[float] = []
        for t, missed in reversed(self._stamps):
            if not missed:
                break
            poor.append(t)
        enough = len(poor) >= POOR_FRAMES and poor[0] - poor[-1] >= POOR_TIME
        return poor[-1] if enough else None

    def follow(self, observation: object, odometry: ChainState, view: object) -> None:
        """Do nothing, because :meth:`refuted_since` judges the track by missing points."""

    def refuted_since(self, m: Pixels, odometry: ChainState, pose: Array, covariance: Array) -> float | None:
        """Return the time [s] since which the track must have been wrong, or None. Call this after an image was processed.

        The track is wrong if points have been missing since that time, and the last images agree on a pose other than ``pose``
        (3,). The covariance of the track is not used. A large covariance would excuse a track that misses points.
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
        """Find the pose from an image ``m`` at the odometry state ``odometry``. Returns False if no pose is found."""
        if not self._fixes and m.t < self._fruitless + SEARCH_INTERVAL and m.t >= self._fruitless:
            return False
        self._fixes = [f for f in self._fixes if m.t - KEPT <= f.odometry.t < m.t]
        fix, expected = self._points.find(m)
        if fix is None:
            self._fruitless = m.t
            return False
        if self.start is not None and self._is_not_from(self.start, fix, odometry):
            self._fruitless = m.t
            return False
        count = int(np.count_nonzero(fix.inliers))
        clear = count >= CLEAR and count >= CLEAR_SHARE * expected
        self._fixes.append(_Fix(odometry, fix.pose, fix.covariance, clear))
        return True

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` poses (N, 3) that are sampled around the pose from the last image."""
        last = self._fixes[-1]
        body = last.covariance + LEAST
        return np.asarray(se2.compose(last.pose, se2.exp(rng.multivariate_normal(np.zeros(3), body, count))))

    def clear(self) -> None:
        """Discard the images. Call this if the estimated trajectory starts again, or if it is known to be right."""
        self._fixes, self._stamps = [], []

    @staticmethod
    def _is_not_from(start: KnownPosition, fix: FoundOnFloor, now: ChainState) -> bool:
        """True if a robot that started at the known position ``start`` cannot be at the pose ``fix``, which one image
        determined. ``now``: the odometry state at the image."""
        return bool(2.0 * start.loss(fix.pose[None], now, fix.covariance + LEAST)[0] > APART)

    def _agree(self) -> bool:
        """True if the poses from the last images agree, after each is moved to the last image by the odometry."""
        if len(self._fixes) < AGREEING:
            return False
        *others, last = self._fixes[-AGREEING:]
        for fix in others:
            moved = self._motion.relative(fix.odometry, last.odometry)
            if _distance(se2.compose(fix.pose, moved.delta), propagate(fix.covariance, moved), last) > APART:
                return False
        return True


def _distance(pose: Array, covariance: Array, fix: _Fix) -> float:
    """Return the squared Mahalanobis distance between ``pose`` (3,) with body-frame ``covariance`` (3, 3), and the pose
    of ``fix``, which one image determined."""
    error = se2.log(se2.between(pose, fix.pose))
    return float(error @ positive.solve(covariance + fix.covariance + LEAST, error[:, None])[:, 0])
