"""A pinhole camera with distortion on a robot: where points are seen, and how that depends on everything.

The camera sits on the robot at ``rTc``; its axes are z forward, x right, y down. A point p in the camera's frame is seen at the
pixel (fx x + cx, fy y + cy) of its distorted direction (x, y), with radial and tangential distortion (k1, k2, p1, p2) after
Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8), 1971, as OpenCV and ``gtsam.Cal3DS2`` have it. The noise
of a pixel is Gaussian in its core; the loss of Huber (1964) limits the pull of a point that is wrong.

Points that are nearer than :data:`NEAREST` or behind the camera are taken as that far away, and are seen far outside of the
image: nothing throws, and every value is finite.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numba
import numpy as np

from factors import se2
from factors.se2 import Array

# the constants of a camera that can be estimated: its place [m] and small turns [rad] about the robot's axes, the
# logarithm of its focal length, and how much later it saw than its stamp says [s]
PARAMETERS = ("x", "y", "z", "roll", "pitch", "yaw", "focal", "time_offset")
FOCAL, TIME_OFFSET = PARAMETERS.index("focal"), PARAMETERS.index("time_offset")
NEAREST = 0.05  # m in front of the camera
WIDEST = 4.0  # square of x^2 + y^2 beyond which the distortion grows no more: its polynomial means nothing there

# columns: the camera's axes in the frame of a robot that looks along its x axis, z up
FORWARD: Array = np.array(((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))


@dataclass(frozen=True, slots=True)
class CameraModel:
    """What we believe about a camera.

    ``fx``, ``fy``, ``cx``, ``cy`` [px]; ``distortion`` (k1, k2, p1, p2); ``width``, ``height`` [px] of its images. ``position``
    (3,) [m] and ``rotation`` (3, 3) of the camera in the robot's frame. ``sigma`` [px] in u and in v; ``robust``: scale of
    Huber's loss in standard deviations. ``tempering``: exponent of the likelihood, below 1 where errors stay from image to image.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    position: Array = field(default_factory=lambda: np.zeros(3))
    rotation: Array = field(default_factory=FORWARD.copy)
    sigma: float = 1.0
    robust: float = 2.0
    tempering: float = 1.0

    def intrinsics(self) -> Array:
        """(fx, fy, cx, cy, k1, k2, p1, p2) as an array (8,)."""
        return np.array((self.fx, self.fy, self.cx, self.cy, *self.distortion))

    def matrix(self) -> Array:
        """The camera matrix (3, 3)."""
        return np.array(((self.fx, 0.0, self.cx), (0.0, self.fy, self.cy), (0.0, 0.0, 1.0)))

    def calibration(self) -> gtsam.Cal3DS2:
        """The same as GTSAM has it."""
        return gtsam.Cal3DS2(self.fx, self.fy, 0.0, self.cx, self.cy, *self.distortion)

    def contains(self, pixels: Array, margin: float = 0.0) -> Any:
        """Whether ``pixels`` (..., 2) lie in the image, or at most ``margin`` pixels outside of it: truth values (...)."""
        u, v = pixels[..., 0], pixels[..., 1]
        inside = (u >= -0.5 - margin) & (u <= self.width - 0.5 + margin)
        return inside & (v >= -0.5 - margin) & (v <= self.height - 0.5 + margin)


def mounting(roll: float, pitch: float, yaw: float) -> Array:
    """The rotation (3, 3) of a camera in the robot's frame that looks along x and is then turned: ``roll`` about x,
    ``pitch`` about y (down where positive), ``yaw`` about z (to the left)."""
    (a, b), (c, d), (e, f) = ((math.cos(w), math.sin(w)) for w in (roll, pitch, yaw))
    about_x = np.array(((1.0, 0.0, 0.0), (0.0, a, -b), (0.0, b, a)))
    about_y = np.array(((c, 0.0, d), (0.0, 1.0, 0.0), (-d, 0.0, c)))
    about_z = np.array(((e, -f, 0.0), (f, e, 0.0), (0.0, 0.0, 1.0)))
    return np.asarray(about_z @ about_y @ about_x @ FORWARD)


def recalibrated(model: CameraModel, changes: Array) -> CameraModel:
    """The model with ``changes`` (8,) of the constants :data:`PARAMETERS`; the time offset is the caller's business."""
    turn = np.asarray(gtsam.Rot3.Expmap(changes[3:6]).matrix())
    scale = math.exp(float(changes[FOCAL]))
    return replace(
        model,
        fx=scale * model.fx,
        fy=scale * model.fy,
        position=model.position + changes[:3],
        rotation=turn @ model.rotation,
    )


def project(model: CameraModel, points: Array) -> Array:
    """Pixels (K, 2) of ``points`` (K, 3) in the camera's frame."""
    return np.asarray(_project(model.intrinsics(), np.ascontiguousarray(points, dtype=float))[0])


def in_camera(model: CameraModel, pose: Array, points: Array) -> Array:
    """``points`` (K, 3) of the world in the frame of the camera of a robot at ``pose`` (3,)."""
    local = np.empty_like(points, dtype=float)
    local[:, :2] = se2.transform_to(pose, points[:, :2])
    local[:, 2] = points[:, 2]
    return np.asarray((local - model.position) @ model.rotation)


def camera_pose(model: CameraModel, pose: Array) -> tuple[Array, Array]:
    """Position (3,) and rotation (3, 3) in the world of the camera of a robot at ``pose`` (3,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    return np.array((pose[0], pose[1], 0.0)) + turn @ model.position, turn @ model.rotation


def predict(model: CameraModel, pose: Array, points: Array) -> tuple[Array, Array]:
    """Pixels (K, 2) at which ``points`` (K, 3) of the world are seen from ``pose`` (3,), and their depths (K,) [m], below zero
    behind the camera."""
    local = in_camera(model, pose, points)
    return project(model, local), local[:, 2]


def undistorted(model: CameraModel, pixels: Array) -> Array:
    """Directions (K, 2), as (x, y) at depth 1 in the camera's frame, of ``pixels`` (K, 2)."""
    x0 = (np.asarray(pixels, dtype=float) - (model.cx, model.cy)) / (model.fx, model.fy)
    k1, k2, p1, p2 = model.distortion
    xy = x0.copy()
    for _ in range(20):  # fixed point: contracts by about k1 r^2 each time
        x, y = xy[:, 0], xy[:, 1]
        rr = np.minimum(x * x + y * y, WIDEST)
        radial = 1.0 + k1 * rr + k2 * rr * rr
        shift = np.column_stack((2 * p1 * x * y + p2 * (rr + 2 * x * x), p1 * (rr + 2 * y * y) + 2 * p2 * x * y))
        xy = (x0 - shift) / np.maximum(radial, 0.1)[:, None]
    return xy


def linearize(model: CameraModel, pose: Array, points: Array) -> tuple[Array, Array, Array, Array]:
    """Pixels (K, 2) of ``points`` (K, 3) seen from the planar ``pose`` (3,), and their Jacobians: by the pose's body-frame
    perturbation (K, 2, 3), by the points (K, 2, 3), and by small changes of :data:`PARAMETERS` (K, 2, 8), of which that by the
    time offset is zero here, as it needs the robot's velocity."""
    found: tuple[Array, Array, Array, Array] = _linearize(
        model.intrinsics(), model.position, model.rotation, pose, np.ascontiguousarray(points, dtype=float)
    )
    return found


def linearize_in_space(
    model: CameraModel, position: Array, rotation: Array, points: Array
) -> tuple[Array, Array, Array]:
    """Pixels (K, 2) of ``points`` (K, 3) seen from a camera anywhere in space, at ``position`` (3,) with ``rotation`` (3, 3) in the
    world; their Jacobians by the camera's perturbation (K, 2, 6), turn first, then shift, both in the camera's frame as
    ``gtsam.Pose3`` has them, and by the points (K, 2, 3)."""
    local = (np.asarray(points, dtype=float) - position) @ rotation
    pixels, by_local = _project(model.intrinsics(), np.ascontiguousarray(local))
    by_camera = np.empty((len(local), 2, 6))
    # a turn w moves the point in the camera's frame by -w x p
    by_camera[..., :3] = by_local @ _cross_matrices(local)
    by_camera[..., 3:] = -by_local
    return pixels, by_camera, by_local @ rotation.T


def log_likelihood(
    model: CameraModel, poses: Array, points: Array, pixels: Array, covariances: Array | None = None
) -> Array:
    """The log-likelihood (N,), robust and tempered, of seeing ``points`` (K, 3) at ``pixels`` (K, 2) from ``poses`` (N, 3), up to a
    constant.

    ``covariances`` (K, 2, 2) [px^2]: of each pixel, from its noise and that of the map; by default that of the model.
    """
    if covariances is None:
        whiteners = np.broadcast_to(np.eye(2) / model.sigma, (len(points), 2, 2)).copy()
    else:
        whiteners = np.linalg.inv(np.linalg.cholesky(covariances))
    arguments = (model.intrinsics(), model.position, model.rotation, np.ascontiguousarray(poses, dtype=float))
    return model.tempering * np.asarray(
        _log_likelihood(
            *arguments,
            np.ascontiguousarray(points, dtype=float),
            np.ascontiguousarray(pixels, dtype=float),
            whiteners,
            model.robust,
        )
    )


def huber_loss(squared: Array, scale: float) -> Array:
    """The loss of squared whitened residuals: half of them up to ``scale`` standard deviations, linear beyond."""
    size = np.sqrt(squared)
    return np.where(size <= scale, 0.5 * squared, scale * (size - 0.5 * scale))


def huber_weight(squared: Array, scale: float) -> Array:
    """The weight of squared whitened residuals in iteratively reweighted least squares."""
    return np.asarray(scale / np.maximum(np.sqrt(squared), scale))


def _cross_matrices(v: Array) -> Array:
    """The matrices (K, 3, 3) that take the cross product of ``v`` (K, 3) with a vector."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return out


@numba.njit(cache=True)
def _pixel(k: Array, p0: float, p1: float, p2: float, jacobian: Array) -> tuple[float, float]:
    """The pixel of a point, and into ``jacobian`` (2, 3) how it depends on the point."""
    near = p2 < NEAREST
    z = NEAREST if near else p2
    x, y = p0 / z, p1 / z
    r2 = x * x + y * y
    wide = r2 > WIDEST
    rr = WIDEST if wide else r2
    d = 0.0 if wide else 1.0  # derivative of rr by r2
    radial = 1.0 + k[4] * rr + k[5] * rr * rr
    slope = (k[4] + 2.0 * k[5] * rr) * d
    xd = x * radial + 2.0 * k[6] * x * y + k[7] * (rr + 2.0 * x * x)
    yd = y * radial + k[6] * (rr + 2.0 * y * y) + 2.0 * k[7] * x * y
    xx = radial + 2.0 * x * x * slope + 2.0 * k[6] * y + k[7] * (2.0 * x * d + 4.0 * x)
    xy = 2.0 * x * y * slope + 2.0 * k[6] * x + 2.0 * k[7] * y * d
    yx = 2.0 * x * y * slope + 2.0 * k[6] * x * d + 2.0 * k[7] * y
    yy = radial + 2.0 * y * y * slope + k[6] * (2.0 * y * d + 4.0 * y) + 2.0 * k[7] * x
    fx, fy = k[0] / z, k[1] / z
    jacobian[0, 0], jacobian[0, 1] = fx * xx, fx * xy
    jacobian[1, 0], jacobian[1, 1] = fy * yx, fy * yy
    jacobian[0, 2] = 0.0 if near else -fx * (xx * x + xy * y)
    jacobian[1, 2] = 0.0 if near else -fy * (yx * x + yy * y)
    return k[0] * xd + k[2], k[1] * yd + k[3]


@numba.njit(cache=True)
def _project(k: Array, points: Array) -> tuple[Array, Array]:
    n = len(points)
    pixels, jacobians = np.empty((n, 2)), np.empty((n, 2, 3))
    for i in range(n):
        p = points[i]
        pixels[i, 0], pixels[i, 1] = _pixel(k, p[0], p[1], p[2], jacobians[i])
    return pixels, jacobians


@numba.njit(cache=True)
def _linearize(
    k: Array, position: Array, rotation: Array, pose: Array, points: Array
) -> tuple[Array, Array, Array, Array]:
    n = len(points)
    pixels, by_pose, by_point = np.empty((n, 2)), np.empty((n, 2, 3)), np.empty((n, 2, 3))
    by_parameters = np.zeros((n, 2, 8))
    c, s = math.cos(pose[2]), math.sin(pose[2])
    by_local, by_robot = np.empty((2, 3)), np.empty((2, 3))
    for i in range(n):
        dx, dy = points[i, 0] - pose[0], points[i, 1] - pose[1]
        rx, ry, rz = c * dx + s * dy, c * dy - s * dx, points[i, 2]  # in the robot's frame
        ax, ay, az = rx - position[0], ry - position[1], rz - position[2]
        lx = rotation[0, 0] * ax + rotation[1, 0] * ay + rotation[2, 0] * az
        ly = rotation[0, 1] * ax + rotation[1, 1] * ay + rotation[2, 1] * az
        lz = rotation[0, 2] * ax + rotation[1, 2] * ay + rotation[2, 2] * az
        u, v = _pixel(k, lx, ly, lz, by_local)
        pixels[i, 0], pixels[i, 1] = u, v
        for r in range(2):
            for j in range(3):
                by_robot[r, j] = (
                    by_local[r, 0] * rotation[j, 0] + by_local[r, 1] * rotation[j, 1] + by_local[r, 2] * rotation[j, 2]
                )
            b0, b1, b2 = by_robot[r, 0], by_robot[r, 1], by_robot[r, 2]
            by_pose[i, r, 0], by_pose[i, r, 1], by_pose[i, r, 2] = -b0, -b1, b0 * ry - b1 * rx
            by_point[i, r, 0], by_point[i, r, 1], by_point[i, r, 2] = c * b0 - s * b1, s * b0 + c * b1, b2
            by_parameters[i, r, 0], by_parameters[i, r, 1], by_parameters[i, r, 2] = -b0, -b1, -b2
            by_parameters[i, r, 3] = b1 * az - b2 * ay
            by_parameters[i, r, 4] = b2 * ax - b0 * az
            by_parameters[i, r, 5] = b0 * ay - b1 * ax
        by_parameters[i, 0, 6] = u - k[2]
        by_parameters[i, 1, 6] = v - k[3]
    return pixels, by_pose, by_point, by_parameters


@numba.njit(cache=True)
def _log_likelihood(
    k: Array,
    position: Array,
    rotation: Array,
    poses: Array,
    points: Array,
    pixels: Array,
    whiteners: Array,
    scale: float,
) -> Array:
    out = np.empty(len(poses))
    unused = np.empty((2, 3))
    for n in range(len(poses)):
        c, s = math.cos(poses[n, 2]), math.sin(poses[n, 2])
        total = 0.0
        for i in range(len(points)):
            dx, dy = points[i, 0] - poses[n, 0], points[i, 1] - poses[n, 1]
            ax, ay, az = c * dx + s * dy - position[0], c * dy - s * dx - position[1], points[i, 2] - position[2]
            lx = rotation[0, 0] * ax + rotation[1, 0] * ay + rotation[2, 0] * az
            ly = rotation[0, 1] * ax + rotation[1, 1] * ay + rotation[2, 1] * az
            lz = rotation[0, 2] * ax + rotation[1, 2] * ay + rotation[2, 2] * az
            u, v = _pixel(k, lx, ly, lz, unused)
            eu, ev = u - pixels[i, 0], v - pixels[i, 1]
            w = whiteners[i]
            a, b = w[0, 0] * eu + w[0, 1] * ev, w[1, 0] * eu + w[1, 1] * ev
            squared = a * a + b * b
            size = math.sqrt(squared)
            total += 0.5 * squared if size <= scale else scale * (size - 0.5 * scale)
        out[n] = -total
    return out
