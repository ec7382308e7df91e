"""The state of the monoSLAM filter (robot and points), predicted pixels, and the Kalman update.

The error state has 12 values of the robot, P constants of the odometry, and D values of points. The update is in
covariance form. Only the robot's pose and the observed points have columns in the Jacobian of the innovation. The noise
of outliers is increased, as in :mod:`~factors.update`. K is the number of pixels.
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

POSE = 6  # number of components of the pose, which are the first components of the error state
VELOCITY_SIGMA, RATE_SIGMA = 0.5, 0.5  # m/s, rad/s: standard deviations at the start


@dataclass(frozen=True)
class MapPoint:
    """A point in the state of the filter. Its coordinates are in ``values`` of :class:`SlamState`.

    ``ray``: True if the point has six values (inverse depth), False if it has three (x, y, z). ``descriptor``: the
    descriptor of a feature, None for a point with a name only. ``t`` [s]: the last time it was matched. ``expected``,
    ``matched``: the number of images with an expected match, and with a match.
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
    """The state of the filter.

    ``robot``: the state of the robot. ``constants`` (P,): corrections of the odometry's constants. ``covariance``
    (12 + P + D, 12 + P + D): of the error of robot, constants and points. ``points``, ``values`` (D,): the points of
    the state, and their values one point after the other. ``tracks``: the identifiers of the feature tracks of the
    newest image. ``met``: the number of points ever added. ``lost``: the number of consecutive images without a match.
    ``image_odometry``: the odometry at the newest image. ``floor``: the estimated standard deviation of the robot's
    tilt, or None if it is not estimated.
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
        """The number of components of the error state that precede those of the points."""
        return ROBOT + len(self.constants)

    def starts(self) -> Integers:
        """Return the index of each point's first value in ``values``."""
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
        """Return the standard deviation of roll and pitch [rad], and the time constant [s] of their change. ``usual``:
        the standard deviation to return if the filter does not estimate it."""
        return (usual, SETTLING) if self.floor is None else (self.floor.sigma, UNEVEN)

    def widened(self, planar: Array) -> SlamState:
        """Return the state with ``planar`` (3, 3) added to the covariance of x, y and heading in the robot's frame."""
        covariance = self.covariance.copy()
        covariance[np.ix_(PLANAR, PLANAR)] += planar
        return replace(self, covariance=covariance)

    def moved(self, step: Step) -> SlamState:
        """Return the state after the prediction ``step``. Points keep their positions."""
        return replace(self, robot=step.robot, covariance=step.carried(self.covariance))


def with_floor(prior: SlamState, posterior: SlamState, t: float) -> SlamState:
    """Return ``posterior`` with an updated estimate ``floor`` of the standard deviation of the robot's tilt.

    ``prior``, ``posterior``: the states before and after the update by an image at time ``t`` [s]. The new value is
    estimated from the change of the tilt since the previous image.
    """
    if prior.floor is None or prior.image_odometry is None or t <= prior.image_odometry.t:
        return replace(posterior, floor=prior.floor)
    sigma = prior.floor.sigma
    share = -math.expm1(-2.0 * (t - prior.image_odometry.t) / UNEVEN)  # fraction of the tilt's variance that is new
    was, now = (positive.inverse(s.covariance[:2, :2]) for s in (prior, posterior))
    gained, known = now - was, prior.covariance[:2, :2] - share * sigma**2 * np.eye(2)
    weight = np.linalg.inv(np.eye(2) + gained @ known)  # fraction of the information that is about the change of tilt
    covariance = positive.inverse(share * weight @ gained + np.eye(2) / sigma**2)
    tilt = math.sqrt(share) * covariance @ weight @ now @ (tilt_of(posterior.robot) - tilt_of(prior.robot))
    return replace(posterior, floor=prior.floor.learnt(tilt, covariance, sigma)[0])


def of_mounting(camera: CameraSettings) -> Array:
    """Return the covariance (6, 6) of the robot's pose that the uncertainty of the camera's mounting causes, in the
    robot's frame."""
    u, lever = camera.uncertainty, np.eye(6)
    lever[SHIFT, TURN] = cross(camera.model().position)
    return (lever * np.square((u.roll, u.pitch, u.yaw, u.x, u.y, u.z))) @ lever.T


@dataclass(frozen=True)
class Sights:
    """The predicted pixels of K points, with Jacobians.

    ``pixels`` (K, 2) [px]. ``depths`` (K,): positive for a point in front of the camera. It is the depth [m], or for a
    point with inverse depth the product of both. ``by_pose``, ``by_point`` (K, 2, 6): Jacobians with respect to the
    robot's pose and to the point's values. ``starts`` (K,): index of the point's first value in the error state.
    ``sizes`` (K,): number of the point's values, 0 for a point of the map. ``noise`` (K, 2, 2) [px^2]: covariance of
    pixel noise and map errors.
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
        """Return the indices (C,) of the components of the error state that influence the pixels. Also return the
        Jacobian (2K, C) of the pixels by these components."""
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
    """The camera on the robot. It predicts the pixels of points from a state.

    ``model``: its calibration. ``lift`` (6, 6): Jacobian of a perturbation of the camera's pose with respect to a
    perturbation of the robot's pose, each in its own frame.
    """

    model: CameraModel
    lift: Array

    @staticmethod
    def of(model: CameraModel) -> Eye:
        return Eye(model, lift(model))

    def pose(self, robot: RobotState) -> tuple[Array, Array]:
        """Return position (3,) and rotation (3, 3) of the camera on ``robot``, in the world frame."""
        return mounted(self.model, robot.position, robot.rotation)

    def predicted(self, state: SlamState) -> CameraPose:
        """Return the pose of the camera with its covariance, computed from the ``state`` of the robot."""
        return CameraPose(*self.pose(state.robot), self.lift @ state.covariance[:POSE, :POSE] @ self.lift.T)

    def known(self, robot: RobotState, points: Array, covariances: Array | None) -> Sights:
        """Return the predicted pixels of map points at the state ``robot``. ``points`` (K, 3), ``covariances`` (K, 3,
        3): their positions and covariances, None for exact positions."""
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
        """Return the predicted pixels of the points of the state with the indices ``which``."""
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
        """Return the predicted pixels of the points ``which`` (indices) of the state, followed by those of map points.
        ``points`` (K, 3), ``covariances`` (K, 3, 3): positions of the map points, and their covariances or None."""
        first, second = self.mapped(state, which), self.known(state.robot, points, covariances)
        if not len(first) or not len(second):
            return first if len(first) else second
        names = Sights.__dataclass_fields__
        return Sights(*(np.concatenate((getattr(first, name), getattr(second, name))) for name in names))


@dataclass(frozen=True)
class Innovation:
    """The covariance of K predicted pixels in a Kalman update.

    ``carried`` (12 + P + D, 2K): the covariance between the error state and the predicted pixels. ``jacobian`` (2K, C):
    the Jacobian of the pixels by C components of the error state. ``columns`` (C,): the indices of these components.
    ``covariance`` (2K, 2K) [px^2]: the covariance of the predicted pixels, without pixel noise.
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
        """Return the innovation covariances (K, 2, 2) of the single pixels, including ``noise`` (K, 2, 2)."""
        k = np.arange(len(noise))
        blocks = self.covariance.reshape(2 * noise.shape[:2])
        return np.asarray(blocks[k, :, k, :] + noise)

    def total(self, noise: Array) -> Array:
        """Return the innovation covariance (2K, 2K) of all pixels, including ``noise`` (K, 2, 2)."""
        total = self.covariance.copy()
        blocks = total.reshape(2 * noise.shape[:2])
        k = np.arange(len(noise))
        blocks[k, :, k, :] += noise
        return total

    def root(self, noise: Array) -> Array:
        """Return the Cholesky factor (2K, 2K) of the innovation covariance, including ``noise`` (K, 2, 2)."""
        return positive.root(self.total(noise))

    def gain(self, noise: Array) -> tuple[Array, Array]:
        """Return L and M, two factors of the Kalman gain M.T @ inv(L). L: the Cholesky factor (2K, 2K) of the
        innovation covariance with ``noise`` (K, 2, 2). M: inv(L) @ H @ P, with the Jacobian H and the state covariance P."""
        root = self.root(noise)
        return root, np.asarray(solve_triangular(root, self.carried.T, lower=True, check_finite=False))


def squared(residual: Array, covariance: Array) -> Array:
    """Return the squared Mahalanobis distances (K,) of each ``residual`` (K, 2) with its ``covariance`` (K, 2, 2)."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    x, y = residual[:, 0], residual[:, 1]
    return np.asarray((c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b))


def starting(sigmas: Array) -> Array:
    """Return the covariance (12 + P, 12 + P) of the error state at the start, with zeros for the pose. ``sigmas`` (P,):
    the standard deviations of the odometry's constants."""
    motion = np.array([0.0] * POSE + [VELOCITY_SIGMA] * 3 + [RATE_SIGMA] * 3)
    return np.diag(np.concatenate((motion, sigmas)) ** 2)


def widened(noise: Array, residual: Array, innovation: Innovation) -> Array:
    """Return ``noise`` (K, 2, 2) with larger covariances for pixels that are far from their prediction.

    Let r be the squared Mahalanobis distance of a ``residual`` (K, 2), divided by the limit of inliers. If r > 1, the
    noise is multiplied by r^2. ``innovation``: the covariance of the predicted pixels.
    """
    excess = np.maximum(1.0, squared(residual, innovation.each(noise)) / GATE)
    return np.asarray(noise * (excess**2)[:, None, None])
