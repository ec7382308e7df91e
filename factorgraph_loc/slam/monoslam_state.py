"""The state of the monoSLAM filter (robot and points), predicted pixels, and the Kalman update.

The update is in covariance form: of the 12 + D error values, only the columns of the robot's pose and of observed points enter
the innovation. The noise of outliers is widened, as in :mod:`~factors.update`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.slam.monoslam_motion import (
    ROBOT,
    SETTLING,
    SHIFT,
    TURN,
    UNEVEN,
    RobotState,
    Step,
    cross,
    tilt_of,
)
from factorgraph_loc.vision.consensus import CameraPose
from factors import positive
from factors.camera import inverse_depth
from factors.camera.model import PLANAR, CameraModel, TiltScale, lift, linearize_in_space, mounted
from factors.motion import ChainState
from factors.se2 import Array, Integers
from factors.update import GATE

POSE = 6  # first values of the error state: those of the pose
VELOCITY_SIGMA, RATE_SIGMA = 0.5, 0.5  # m/s, rad/s at the start


@dataclass(frozen=True)
class MapPoint:
    """A point in the state, with six values (``ray``) or three. ``descriptor`` (D,): of a feature, else None. ``expected``,
    ``matched``: number of times it should have been found, and was; ``t`` [s]: the last time it was found.
    """

    name: str
    ray: bool
    descriptor: NDArray[Any] | None
    t: float
    expected: int = 0
    matched: int = 0

    @property
    def size(self) -> int:
        return inverse_depth.SIZE if self.ray else 3


@dataclass(frozen=True)
class SlamState:
    """``robot``, corrections ``constants`` (P,) of the odometry's constants, and ``values`` (D,) of ``points`` one after the other;
    ``covariance`` (12 + P + D, 12 + P + D) of the error state.

    ``tracks``: in the newest image; ``met``: number of points so far; ``lost``: consecutive images without a match;
    ``image_odometry``: the odometry at the newest image; ``floor``: how level it is, if that is learnt.
    """

    robot: RobotState
    constants: Array
    covariance: Array
    points: tuple[MapPoint, ...] = ()
    values: Array = field(default_factory=lambda: np.zeros(0))
    tracks: frozenset[int] = frozenset()
    met: int = 0
    lost: int = 0
    image_odometry: ChainState | None = None
    floor: TiltScale | None = None

    @property
    def base(self) -> int:
        """The number of error values before those of the points."""
        return ROBOT + len(self.constants)

    def starts(self) -> Integers:
        """The index of each point's first value in ``values``."""
        return np.cumsum([0, *(p.size for p in self.points)], dtype=np.int64)[:-1]

    def plus(self, error: Array, covariance: Array) -> SlamState:
        return replace(
            self,
            robot=self.robot.plus(error[:ROBOT]),
            constants=self.constants + error[ROBOT : self.base],
            values=self.values + error[self.base :],
            covariance=covariance,
        )

    def sway(self, usual: float) -> tuple[float, float]:
        """Standard deviation of the tilt [rad], ``usual`` where no floor is learnt, and its time constant [s]."""
        return (usual, SETTLING) if self.floor is None else (self.floor.sigma, UNEVEN)

    def widened(self, planar: Array) -> SlamState:
        """The state of a robot whose x, y and heading are less certain, by ``planar`` (3, 3)."""
        covariance = self.covariance.copy()
        covariance[np.ix_(PLANAR, PLANAR)] += planar
        return replace(self, covariance=covariance)

    def moved(self, step: Step) -> SlamState:
        """The state after a prediction, which changes the robot alone."""
        return replace(self, robot=step.robot, covariance=step.carried(self.covariance))


def with_floor(prior: SlamState, posterior: SlamState, t: float) -> SlamState:
    """The state ``posterior`` with an update of how level the floor is.

    The evidence is the change of tilt since the last image. Points lean with the robot that observed them first. ``t`` [s]: time of
    the image.
    """
    if prior.floor is None or prior.image_odometry is None or t <= prior.image_odometry.t:
        return replace(posterior, floor=prior.floor)
    sigma = prior.floor.sigma
    share = -math.expm1(-2.0 * (t - prior.image_odometry.t) / UNEVEN)  # of the variance of the tilt that is new
    was, now = (positive.inverse(s.covariance[:2, :2]) for s in (prior, posterior))
    gained, known = now - was, prior.covariance[:2, :2] - share * sigma**2 * np.eye(2)
    weight = np.linalg.inv(np.eye(2) + gained @ known)  # of the evidence for the new part
    covariance = positive.inverse(share * weight @ gained + np.eye(2) / sigma**2)
    tilt = math.sqrt(share) * covariance @ weight @ now @ (tilt_of(posterior.robot) - tilt_of(prior.robot))
    return replace(posterior, floor=prior.floor.learnt(tilt, covariance, sigma)[0])


def of_mounting(camera: CameraSettings) -> Array:
    """The covariance (6, 6) of the robot's pose for an exact pose of the camera, from the uncertainty of the mounting."""
    u, lever = camera.uncertainty, np.eye(6)
    lever[SHIFT, TURN] = cross(camera.model().position)
    return (lever * np.square((u.roll, u.pitch, u.yaw, u.x, u.y, u.z))) @ lever.T


@dataclass(frozen=True)
class Sights:
    """K predicted pixels: ``pixels`` (K, 2), ``depths`` (K,), and Jacobians with respect to the robot's pose (K, 2, 6) and the
    point's own values (K, 2, 6). ``sizes`` (K,): number of these values; 0 for a map point, which is not in the state.
    ``starts`` (K,): index of the point's values in the error state. ``noise`` (K, 2, 2) [px^2]: of pixel and map.
    """

    pixels: Array
    depths: Array
    by_pose: Array
    by_point: Array
    starts: Integers
    sizes: Integers
    noise: Array

    def __len__(self) -> int:
        return len(self.pixels)

    def __getitem__(self, rows: Any) -> Sights:
        return Sights(*(getattr(self, name)[rows] for name in Sights.__dataclass_fields__))

    def columns(self) -> tuple[Integers, Array]:
        """The Jacobian (2K, C) with respect to the C values of the error state it depends on, and their indices."""
        own = np.unique(self.starts[self.sizes > 0], return_index=True, return_inverse=True)
        where, first, which = own
        sizes = self.sizes[self.sizes > 0][first]
        offsets = POSE + np.concatenate(([0], np.cumsum(sizes)))
        chosen = np.concatenate([np.arange(POSE), *(np.arange(s, s + n) for s, n in zip(where, sizes, strict=True))])
        jacobian = np.zeros((*self.pixels.shape, len(chosen)))
        jacobian[:, :, :POSE] = self.by_pose
        for k, w in zip(np.flatnonzero(self.sizes).tolist(), which.tolist(), strict=True):
            jacobian[k, :, offsets[w] : offsets[w + 1]] = self.by_point[k, :, : sizes[w]]
        return chosen.astype(np.int64), jacobian.reshape(-1, len(chosen))


@dataclass(frozen=True)
class Eye:
    """A camera: its ``model``, and the Jacobian (6, 6) of its perturbation with respect to that of the robot."""

    model: CameraModel
    lift: Array

    @staticmethod
    def of(model: CameraModel) -> Eye:
        return Eye(model, lift(model))

    def pose(self, robot: RobotState) -> tuple[Array, Array]:
        """Position and rotation of the camera in the world."""
        return mounted(self.model, robot.position, robot.rotation)

    def predicted(self, state: SlamState) -> CameraPose:
        """The pose of the camera with its covariance."""
        return CameraPose(*self.pose(state.robot), self.lift @ state.covariance[:POSE, :POSE] @ self.lift.T)

    def known(self, robot: RobotState, points: Array, covariances: Array | None) -> Sights:
        """Predicted pixels of map ``points`` (K, 3) with covariances ``covariances`` (K, 3, 3); None: exact."""
        position, rotation = self.pose(robot)
        pixels, by_camera, by_point = linearize_in_space(self.model, position, rotation, points)
        depths = (points - position) @ rotation[:, 2]
        noise = np.broadcast_to(self.model.sigma**2 * np.eye(2), (len(points), 2, 2))
        if covariances is not None:
            noise = noise + by_point @ covariances @ by_point.transpose(0, 2, 1)
        nothing = np.zeros(len(points), dtype=np.int64)
        by_pose = by_camera @ self.lift
        return Sights(pixels, depths, by_pose, np.zeros_like(by_pose), nothing, nothing, noise)

    def mapped(self, state: SlamState, which: Sequence[int]) -> Sights:
        """Predicted pixels of the points ``which`` of the state."""
        position, rotation = self.pose(state.robot)
        count, starts = len(which), state.starts()[list(which)]
        rays = np.array([state.points[i].ray for i in which], dtype=bool)
        pixels, depths = np.empty((count, 2)), np.empty(count)
        by_camera, by_point = np.empty((count, 2, 6)), np.zeros((count, 2, 6))
        for kind, size in ((True, inverse_depth.SIZE), (False, 3)):
            rows = np.flatnonzero(rays == kind)
            values = state.values[starts[rows, None] + np.arange(size)]
            if kind:
                linearized = inverse_depth.linearize(self.model, position, rotation, values)
                ahead = values[:, 5, None] * (values[:, :3] - position) + inverse_depth.directions(values)[0]
            else:
                linearized = linearize_in_space(self.model, position, rotation, values)
                ahead = values - position
            pixels[rows], by_camera[rows], by_point[rows, :, :size] = linearized
            depths[rows] = ahead @ rotation[:, 2]
        noise = np.broadcast_to(self.model.sigma**2 * np.eye(2), (count, 2, 2))
        sizes = np.where(rays, inverse_depth.SIZE, 3)
        return Sights(pixels, depths, by_camera @ self.lift, by_point, starts + state.base, sizes, noise)

    def all(self, state: SlamState, which: Sequence[int], points: Array, covariances: Array | None) -> Sights:
        """Predicted pixels (K, 2) of points of the state, then of the map."""
        first, second = self.mapped(state, which), self.known(state.robot, points, covariances)
        if not len(first) or not len(second):
            return first if len(first) else second
        names = Sights.__dataclass_fields__
        return Sights(*(np.concatenate((getattr(first, name), getattr(second, name))) for name in names))


@dataclass(frozen=True)
class Innovation:
    """``carried`` (12 + D, 2K): covariance of state and predicted pixels; ``jacobian`` (2K, C) with respect to the ``columns``
    (C,) of the error state; ``covariance`` (2K, 2K) of the innovation, without noise.
    """

    carried: Array
    jacobian: Array
    columns: Integers
    covariance: Array

    @staticmethod
    def of(sights: Sights, covariance: Array) -> Innovation:
        columns, jacobian = sights.columns()
        carried = covariance[:, columns] @ jacobian.T
        return Innovation(carried, jacobian, columns, jacobian @ carried[columns])

    def each(self, noise: Array) -> Array:
        """The innovation covariance (K, 2, 2) of each pixel, with ``noise`` (K, 2, 2)."""
        k = np.arange(len(noise))
        blocks = self.covariance.reshape(2 * noise.shape[:2])
        return np.asarray(blocks[k, :, k, :] + noise)

    def total(self, noise: Array) -> Array:
        """The innovation covariance (2K, 2K), with ``noise`` (K, 2, 2)."""
        total = self.covariance.copy()
        blocks = total.reshape(2 * noise.shape[:2])
        k = np.arange(len(noise))
        blocks[k, :, k, :] += noise
        return total

    def root(self, noise: Array) -> Array:
        """The Cholesky factor (2K, 2K) of :meth:`total`."""
        return positive.root(self.total(noise))

    def gain(self, noise: Array) -> tuple[Array, Array]:
        """:meth:`root`, and its inverse times ``carried`` transposed."""
        root = self.root(noise)
        return root, np.asarray(solve_triangular(root, self.carried.T, lower=True, check_finite=False))


def squared(residual: Array, covariance: Array) -> Array:
    """Squared Mahalanobis distances (K,) of ``residual`` (K, 2) with ``covariance`` (K, 2, 2)."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    x, y = residual[:, 0], residual[:, 1]
    return np.asarray((c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b))


def starting(sigmas: Array) -> Array:
    """The covariance (12 + P, 12 + P) of a start, except for the pose; ``sigmas`` (P,): of the constants."""
    motion = np.array([0.0] * POSE + [VELOCITY_SIGMA] * 3 + [RATE_SIGMA] * 3)
    return np.diag(np.concatenate((motion, sigmas)) ** 2)


def widened(noise: Array, residual: Array, innovation: Innovation) -> Array:
    """The ``noise`` (K, 2, 2), widened beyond the gate by the squared excess."""
    excess = np.maximum(1.0, squared(residual, innovation.each(noise)) / GATE)
    return np.asarray(noise * (excess**2)[:, None, None])
