"""The camera sensor of a run, and global localization from images alone.

The sensor observes points of the map, which are identified by name or by appearance. For global localization, one image
with many inliers is sufficient. Otherwise the poses from several images must agree with the odometry between them. If
the start position is known, the pose must also agree with it. An estimated pose is suspicious if several successive
images do not show points of the map at their predicted positions.
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

PASS = 10.0  # s; the survey noise of a point is multiplied by the number of its sightings within this time
SOLVE_EVERY = 0.45  # s between solutions of a graph; other images only correct the newest pose, as in a filter


@dataclass(frozen=True)
class PixelObservation(ResidualObservation):
    """The observation of points in one image.

    ``seen``: the factor of the points. It may also depend on constants of the camera and on displacements of points.
    ``expected`` (3,): the predicted robot pose at which the points were identified. ``held``: None, or the values (P,)
    and the covariance (P, P) of the camera's constants if :meth:`on_pose` treats them as noise.
    """

    iterations: ClassVar[int] = ITERATIONS
    settled: ClassVar[float] = SETTLED
    seen: ReprojectionFactor
    expected: Array = field(default_factory=lambda: np.zeros(3))
    held: tuple[Array, Array] | None = None

    @classmethod
    def of(cls, t: float, seen: ReprojectionFactor, blocks: tuple[str, ...], expected: Array) -> Self:
        """Return the observation with the factor ``seen`` at the time ``t`` [s]. ``blocks``: the names of the state
        blocks that the factor depends on. ``expected`` (3,): the predicted pose of the robot."""
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
                # all pixels share the error of the constants: multiply by their number, so that it does not average out
                common = by_constants @ self.held[1] @ by_constants.transpose(0, 2, 1)
                covariances = covariances + len(common) * common
        return reprojection.log_likelihood(factor.model, poses, factor.points, factor.pixels, tilts, covariances)

    def on_pose(self, values: Blocks, spreads: Blocks) -> Self:
        """Return an observation that depends on the pose only. ``values``: the estimates of the camera's constants and
        of the displacements of points, by the name of the state block. ``spreads``: their covariances by the same
        names, which are added to the noise."""
        if not self.blocks:
            return self
        seen, held, blocks = self.seen, None, self.blocks
        if seen.estimated:
            held, blocks = (values[blocks[0]], spreads[blocks[0]]), blocks[1:]
        if seen.moved_by:
            assert seen.point_covariances is not None
            points, noise = seen.points.copy(), seen.point_covariances.copy()
            for row, which in enumerate(seen.moved_by):
                if which >= 0:  # multiply by the number of points that share the error, so that it does not average out
                    points[row] += values[blocks[which]]
                    noise[row] = seen.moved_by.count(which) * spreads[blocks[which]]
            seen = replace(seen, points=points, point_covariances=noise, moved_by=())
        return replace(self, terms=(Term(seen, (), seen.dof()),), seen=seen, held=held)


class CameraSensor(Sensor):
    """A camera that detects points of the map. The attribute ``points`` identifies them and rejects outliers."""

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
        # by point or marker, the times [s] of its recent sightings; only if its survey error is treated as noise
        self._looks: dict[str, list[float]] = defaultdict(list)
        self._before: deque[tuple[float, TiltScale]] = deque()  # the estimated tilt before each image
        self._shared = (self.name,) if constants.names else ()
        if len(self.points.map):
            self.finder = PixelFinder(self.points, motion)
            # the prediction between solutions is accurate enough, unless constants of the camera are estimated
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
                by, spread = np.zeros(3), self._count_sighting(name, m.t) * survey
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

    def _count_sighting(self, name: str, t: float) -> int:
        """Record a sighting of the point or marker ``name`` at ``t`` [s]. Returns the number of its sightings in the
        last :data:`PASS` seconds."""
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
    """Return a copy of ``factor`` that also depends on displacements of points from the map.

    ``which`` (K): for each of K points, the index of its displacement among the factor's displacement variables, or -1.
    A displacement replaces the survey noise of the point.
    """
    covariances = factor.point_covariances
    if covariances is not None:
        covariances = np.where(np.array(which)[:, None, None] < 0, covariances, 0.0)
    return replace(factor, point_covariances=covariances, moved_by=tuple(which))


def bind(binding: Binding) -> CameraSensor | None:
    """Return the camera sensor of a run, or None if the run does not use it. ``binding``: the arguments of the
    sensor."""
    setup = binding.setup
    if setup.rig.find(CameraSettings) is None or not any(sensor in setup.sensors for sensor in CAMERAS):
        return None
    return CameraSensor(binding, NOTHING if binding.calibration == "none" else setup.rig.estimated("camera"))


CLEAR, CLEAR_SHARE = 8, 0.5  # minimum number and fraction of inliers in an image that alone determines the pose
AGREEING = 3  # number of images that must agree on the pose if no single image determines it
KEPT = 5.0  # s; older images are discarded
APART = 25.0  # two poses disagree if their squared Mahalanobis distance is larger
LEAST = np.diag((0.05, 0.05, 0.03)) ** 2  # m^2, m^2, rad^2; added to the covariances of poses from images
POOR_FRAMES, POOR_TIME = 3, 0.3  # number of images and time [s] with missing points that make a pose suspicious
SEARCH_INTERVAL = 1.0  # s; minimum time between unsuccessful searches


@dataclass(frozen=True)
class _Fix:
    """The ``pose`` (3,) of the robot from one image, with body-frame ``covariance`` (3, 3). ``odometry``: the odometry
    state at the image. ``clear``: True if this image alone determines the pose reliably."""

    odometry: ChainState
    pose: Array
    covariance: Array
    clear: bool


class PixelFinder:
    """Global localization by images. It implements :class:`~factorgraph_loc.sensors.base.Finder`."""

    at_once = True

    def __init__(self, points: KnownPoints, motion: Motion) -> None:
        self._points, self._motion = points, motion
        self.start: KnownPosition | None = None  # the start position if only the heading is unknown
        self._fixes: list[_Fix] = []
        self._stamps: list[tuple[float, bool]] = []
        self._fruitless = -np.inf

    @property
    def newest(self) -> ChainState | None:
        """The odometry state at the last image that determined a pose, or None."""
        return self._fixes[-1].odometry if self._fixes else None

    @property
    def hypotheses(self) -> tuple[Mode, ...]:
        """A tuple with one hypothesis, the pose from the last image that determined a pose. () if there is no such
        image."""
        if not self._fixes:
            return ()
        last = self._fixes[-1]
        return (Mode(1.0, last.pose, se2.body_to_world(last.pose, last.covariance)),)

    @property
    def best(self) -> PosePrior | None:
        """The pose at the last image with a pose, or None if it is ambiguous. It is unambiguous if the image determines
        it reliably, or if poses from previous images agree with it."""
        if not self._fixes or not (self._fixes[-1].clear or self._agree()):
            return None
        last = self._fixes[-1]
        return PosePrior(last.odometry.t, last.pose, se2.body_to_world(last.pose, last.covariance))

    def _suspicious_since(self) -> float | None:
        """Return the time [s] since which map points are missing in all images, or None if this time is too short."""
        poor: list[float] = []
        for t, missed in reversed(self._stamps):
            if not missed:
                break
            poor.append(t)
        enough = len(poor) >= POOR_FRAMES and poor[0] - poor[-1] >= POOR_TIME
        return poor[-1] if enough else None

    def follow(self, observation: object, odometry: ChainState, view: object) -> None:
        """Do nothing, because :meth:`refuted_since` needs no earlier observations."""

    def refuted_since(self, m: Pixels, odometry: ChainState, pose: Array, covariance: Array) -> float | None:
        """Return the time [s] since which the estimated pose has been wrong, or None if the estimate may be right.

        Call this after an estimator has processed the image ``m``. ``odometry``: the odometry state at the image.
        ``pose`` (3,): the estimate at the image. It is wrong if points of the map are missing in the last images, and
        if these images agree on another pose. ``covariance`` is ignored.
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
        """Return True if a pose of the robot fits the image ``m``, and store it for ``hypotheses`` and ``best``.
        ``odometry``: the odometry state at the image."""
        if not self._fixes and m.t < self._fruitless + SEARCH_INTERVAL and m.t >= self._fruitless:
            return False
        self._fixes = [f for f in self._fixes if m.t - KEPT <= f.odometry.t < m.t]
        fix, expected = self._points.find(m)
        if fix is None:
            self._fruitless = m.t
            return False
        if self.start is not None and self._contradicts_start(self.start, fix, odometry):
            self._fruitless = m.t
            return False
        count = int(np.count_nonzero(fix.inliers))
        clear = count >= CLEAR and count >= CLEAR_SHARE * expected
        self._fixes.append(_Fix(odometry, fix.pose, fix.covariance, clear))
        return True

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` random poses (N, 3), drawn from the Gaussian of the pose from the last image. Requires that
        a pose has been computed."""
        last = self._fixes[-1]
        body = last.covariance + LEAST
        return np.asarray(se2.compose(last.pose, se2.exp(rng.multivariate_normal(np.zeros(3), body, count))))

    def clear(self) -> None:
        """Discard all poses from images. Call this if the estimated pose was replaced or confirmed."""
        self._fixes, self._stamps = [], []

    @staticmethod
    def _contradicts_start(start: KnownPosition, fix: FoundOnFloor, now: ChainState) -> bool:
        """Return True if the pose ``fix`` from an image contradicts the known ``start`` position and the odometry.
        ``now``: the odometry state at the image."""
        return bool(2.0 * start.loss(fix.pose[None], now, fix.covariance + LEAST)[0] > APART)

    def _agree(self) -> bool:
        """Return True if the poses from the last images agree with each other and with the odometry between them."""
        if len(self._fixes) < AGREEING:
            return False
        *others, last = self._fixes[-AGREEING:]
        for fix in others:
            moved = self._motion.relative(fix.odometry, last.odometry)
            if _distance(se2.compose(fix.pose, moved.delta), propagate(fix.covariance, moved), last) > APART:
                return False
        return True


def _distance(pose: Array, covariance: Array, fix: _Fix) -> float:
    """Return the squared Mahalanobis distance between ``pose`` (3,) with body-frame ``covariance`` (3, 3) and
    ``fix``."""
    error = se2.log(se2.between(pose, fix.pose))
    return float(error @ positive.solve(covariance + fix.covariance + LEAST, error[:, None])[:, 0])
