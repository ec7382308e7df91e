"""Known points in an image, compiled: a factor of :mod:`factors.camera.factor` on the pose and the tilt of the robot."""

import math
from typing import NamedTuple

import numpy as np

from factors.camera.kernels import Lens, in_camera, mounting, pixel
from factors.compiled import compiled
from factors.gaussian_kernels import corrected
from factors.robust import huber_weight
from factors.se2 import Array
from factors.small_kernels import inverse, put

Row = tuple[float, float, float]
WIDTH = 5  # of a Jacobian by a pose, and by roll and pitch of the robot in standard deviations
REWEIGHTED, STILL = 50, 1e-5  # most rounds to find a tilt, and standard deviations that the last may change it


class Seen(NamedTuple):
    """A :class:`~factors.camera.factor.ReprojectionFactor` on the pose only, for compiled code.

    ``point_covariances`` (K, 3, 3), or (0, 3, 3) for an exact map; ``offset`` (3,) and ``offset_covariance`` (3, 3): zero for none.
    The other fields are those of the factor and its model.
    """

    lens: Lens
    position: Array
    rotation: Array
    points: Array
    pixels: Array
    point_covariances: Array
    offset: Array
    offset_covariance: Array
    sigma: float
    robust: float
    tempering: float
    tilt: float


@compiled(error_model="numpy")
def whitened(seen: Seen, pose: Array) -> tuple[Array, Array]:
    """See :meth:`~factors.camera.factor.ReprojectionFactor.whitened`: residual (K, 2), and its Jacobian (K, 2, 5) by pose and
    tilt."""
    residual, jacobian = np.empty((len(seen.points), 2)), np.empty((len(seen.points), 2, WIDTH))
    _whiten(seen, pose[0], pose[1], pose[2], residual, jacobian)
    return residual, jacobian


@compiled(error_model="numpy")
def linearized(seen: Seen, pose: Array) -> tuple[Array, Array]:
    """See :meth:`~factors.camera.factor.ReprojectionFactor.linearize`: residual (2K,) and Jacobian (2K, 3)."""
    residual, jacobian = whitened(seen, pose)
    return marginal(residual, jacobian, seen.robust, seen.tempering)


@compiled(error_model="numpy")
def tilted(residual: Array, by_tilt: Array, robust: float) -> tuple[float, float, Array]:
    """Roll and pitch, in standard deviations, that fit best to whitened residuals (K, 2) with Jacobians (K, 2, 2), and the robust
    weights (K,) there: by iteratively reweighted least squares, of a convex cost."""
    n, roll, pitch = len(residual), 0.0, 0.0
    weights = np.ones(n)
    for _ in range(REWEIGHTED):
        xx, xy, yy, x, y = 1.0, 0.0, 1.0, 0.0, 0.0
        for k in range(n):
            for r in range(2):
                a, b, w = by_tilt[k, r, 0], by_tilt[k, r, 1], weights[k]
                xx, xy, yy = xx + w * a * a, xy + w * a * b, yy + w * b * b
                x, y = x + w * a * residual[k, r], y + w * b * residual[k, r]
        determinant = xx * yy - xy * xy
        before_roll, before_pitch = roll, pitch
        roll, pitch = (xy * y - yy * x) / determinant, (xy * x - xx * y) / determinant
        for k in range(n):
            u = residual[k, 0] + by_tilt[k, 0, 0] * roll + by_tilt[k, 0, 1] * pitch
            v = residual[k, 1] + by_tilt[k, 1, 0] * roll + by_tilt[k, 1, 1] * pitch
            weights[k] = huber_weight(u * u + v * v, robust)
        if abs(roll - before_roll) + abs(pitch - before_pitch) < STILL:
            break
    return roll, pitch, weights


@compiled(error_model="numpy")
def marginal(residual: Array, jacobian: Array, robust: float, tempering: float) -> tuple[Array, Array]:
    """Whitened, robustly weighted residual (2K,) and Jacobian (2K, D) of points (K, 2) whose Jacobian (K, 2, D + 2) ends with that
    by the tilt, an error that all have in common: with weights W the covariance of the residuals is 1 / W + T T', before it is
    tempered.

    The root of its inverse is that of W times 1 - A C A', with A = W^(1/2) T, H^2 = 1 + A'A, and 1 / C = H (H + 1).
    """
    n, size = len(residual), jacobian.shape[2] - 2
    _, _, weights = tilted(residual, jacobian[:, :, size:], robust)
    out = np.empty((2 * n, size + 3))  # by the values, by the tilt, and the residual
    for k in range(n):
        root = math.sqrt(weights[k])
        for r in range(2):
            for j in range(size + 2):
                out[2 * k + r, j] = root * jacobian[k, r, j]
            out[2 * k + r, size + 2] = root * residual[k, r]
    shared = np.zeros((2, size + 3))
    for i in range(2 * n):
        for j in range(size + 3):
            shared[0, j] += out[i, size] * out[i, j]
            shared[1, j] += out[i, size + 1] * out[i, j]
    a, b, d = 1.0 + shared[0, size], shared[0, size + 1], 1.0 + shared[1, size + 1]
    determinant = math.sqrt(a * d - b * b)
    trace = math.sqrt(a + d + 2.0 * determinant)
    # H (H + 1) = H^2 + H, and H = (H^2 + determinant) / trace
    a, b, d = a + (a + determinant) / trace, b + b / trace, d + (d + determinant) / trace
    determinant = a * d - b * b
    for j in range(size + 3):
        p, q = shared[0, j], shared[1, j]
        shared[0, j], shared[1, j] = (d * p - b * q) / determinant, (a * q - b * p) / determinant
    scale = math.sqrt(tempering)
    for i in range(2 * n):
        p, q = out[i, size], out[i, size + 1]
        for j in range(size + 3):
            out[i, j] = scale * (out[i, j] - p * shared[0, j] - q * shared[1, j])
    return out[:, size + 2].copy(), out[:, :size].copy()


@compiled(error_model="numpy")
def leaning(seen: Seen, pose: Array, covariance: Array) -> tuple[Array, Array]:
    """Roll and pitch (2,) [rad] of a robot at a ``pose`` (3,) with this ``covariance`` (3, 3), as least squares find them in an
    image, and their covariance (2, 2)."""
    residual, jacobian = whitened(seen, pose)
    prior = np.eye(WIDTH)
    put(inverse(covariance), prior)
    known = np.arange(WIDTH), np.ones(len(residual)), np.zeros(WIDTH)
    _, delta, after, _ = corrected(prior, residual, jacobian, *known)
    return seen.tilt * delta[3:], seen.tilt**2 * after[3:, 3:]


@compiled(error_model="numpy")
def placed(position: Array, rotation: Array, tilt: float, pose: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """Position (3,) and rotation (3, 3) in the world of a camera mounted at ``position`` with ``rotation`` on a robot at ``pose``
    (3,), and the covariance (6, 6) of its perturbation in its own frame, rotation first, from ``covariance`` (3, 3) of the pose
    and the standard deviation ``tilt`` [rad] of roll and pitch."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    where, turned, lift, carried = np.empty(3), np.empty((3, 3)), np.zeros((6, WIDTH)), np.empty((6, 6))
    x, y, z = position[0], position[1], position[2]
    where[0], where[1], where[2] = pose[0] + c * x - s * y, pose[1] + s * x + c * y, z
    for i in range(3):
        a, b, d = rotation[0, i], rotation[1, i], rotation[2, i]
        turned[0, i], turned[1, i], turned[2, i] = c * a - s * b, s * a + c * b, d
        lift[i, 2], lift[i, 3], lift[i, 4] = d, tilt * a, tilt * b
        lift[3 + i, 0], lift[3 + i, 1], lift[3 + i, 2] = a, b, x * b - y * a
        lift[3 + i, 3], lift[3 + i, 4] = tilt * (y * d - z * b), tilt * (z * a - x * d)
    for i in range(6):
        p = (lift[i, 0], lift[i, 1], lift[i, 2])
        for j in range(6):
            by_tilt = lift[i, 3] * lift[j, 3] + lift[i, 4] * lift[j, 4]
            carried[i, j] = _product(covariance, p, (lift[j, 0], lift[j, 1], lift[j, 2])) + by_tilt
    return where, turned, carried


@compiled(error_model="numpy")
def spread(by_point: Array, covariances: Array, sigma: float) -> Array:
    """The covariance (K, 2, 2) of pixels with noise ``sigma`` [px], of points with ``covariances`` (K, 3, 3)."""
    out = np.empty((len(by_point), 2, 2))
    for k in range(len(by_point)):
        of = covariances[k]
        p = (by_point[k, 0, 0], by_point[k, 0, 1], by_point[k, 0, 2])
        q = (by_point[k, 1, 0], by_point[k, 1, 1], by_point[k, 1, 2])
        out[k, 0, 0], out[k, 1, 1] = sigma * sigma + _product(of, p, p), sigma * sigma + _product(of, q, q)
        out[k, 0, 1] = out[k, 1, 0] = _product(of, p, q)
    return out


@compiled(inline="always")
def _product(matrix: Array, p: Row, q: Row) -> float:
    """p' M q."""
    x = matrix[0, 0] * q[0] + matrix[0, 1] * q[1] + matrix[0, 2] * q[2]
    y = matrix[1, 0] * q[0] + matrix[1, 1] * q[1] + matrix[1, 2] * q[2]
    z = matrix[2, 0] * q[0] + matrix[2, 1] * q[1] + matrix[2, 2] * q[2]
    return float(p[0] * x + p[1] * y + p[2] * z)


@compiled(error_model="numpy")
def _whiten(seen: Seen, x: float, y: float, heading: float, residual: Array, jacobian: Array) -> None:
    """Whitened residuals (K, 2), predicted minus measured, and their Jacobians (K, 2, 5) by the pose (x, y, heading) and the tilt,
    about the robot's axes on the floor, in place."""
    place, scale, n = mounting(seen.position, seen.rotation), 1.0 / seen.sigma, len(seen.points)
    c, s = math.cos(heading), math.sin(heading)
    dx, dy, turned = seen.offset[0], seen.offset[1], seen.offset[2]
    x, y = x + c * dx - s * dy, y + s * dx + c * dy
    c, s = math.cos(heading + turned), math.sin(heading + turned)
    # of the variable's pose, seen from the pose of the image
    co, so = math.cos(turned), math.sin(turned)
    back_x, back_y = -co * dx - so * dy, so * dx - co * dy
    exact = len(seen.point_covariances) == 0
    common = np.trace(seen.offset_covariance) > 0.0
    for k in range(n):
        away, local = in_camera(place, c, s, seen.points[k, 0] - x, seen.points[k, 1] - y, seen.points[k, 2])
        rx, ry = away[0] + seen.position[0], away[1] + seen.position[1]  # from the robot
        u, v, by_u, by_v = pixel(seen.lens, local[0], local[1], local[2])
        p, q = _along(seen.rotation, by_u, scale), _along(seen.rotation, by_v, scale)
        by_p, by_q = (-p[0], -p[1], p[0] * ry - p[1] * rx), (-q[0], -q[1], q[0] * ry - q[1] * rx)
        rz = seen.tilt * seen.points[k, 2]
        tx, ty = seen.tilt * rx, seen.tilt * ry
        tilt_p = p[1] * rz - p[2] * ty, p[2] * tx - p[0] * rz
        tilt_q = q[1] * rz - q[2] * ty, q[2] * tx - q[0] * rz
        eu, ev = scale * (u - seen.pixels[k, 0]), scale * (v - seen.pixels[k, 1])
        if common or not exact:
            uu, uv, vv = 1.0, 0.0, 1.0
            if not exact:
                of = seen.point_covariances[k]
                in_u, in_v = (
                    (c * p[0] - s * p[1], s * p[0] + c * p[1], p[2]),
                    (
                        c * q[0] - s * q[1],
                        s * q[0] + c * q[1],
                        q[2],
                    ),
                )
                uu, uv, vv = uu + _product(of, in_u, in_u), uv + _product(of, in_v, in_u), vv + _product(of, in_v, in_v)
            if common:
                # this error is common to all points, so it must not average out
                of = seen.offset_covariance
                uu += n * _product(of, by_p, by_p)
                uv += n * _product(of, by_q, by_p)
                vv += n * _product(of, by_q, by_q)
            # by the inverse of the lower root (a, 0; b, d)
            a = math.sqrt(uu)
            b = uv / a
            d = math.sqrt(vv - b * b)
            eu = eu / a
            ev = (ev - b * eu) / d
            by_p = (by_p[0] / a, by_p[1] / a, by_p[2] / a)
            by_q = ((by_q[0] - b * by_p[0]) / d, (by_q[1] - b * by_p[1]) / d, (by_q[2] - b * by_p[2]) / d)
            tilt_p = tilt_p[0] / a, tilt_p[1] / a
            tilt_q = (tilt_q[0] - b * tilt_p[0]) / d, (tilt_q[1] - b * tilt_p[1]) / d
        residual[k, 0], residual[k, 1] = eu, ev
        for r in range(2):
            g, t = (by_p, tilt_p) if r == 0 else (by_q, tilt_q)
            jacobian[k, r, 3], jacobian[k, r, 4] = t
            jacobian[k, r, 0], jacobian[k, r, 1] = co * g[0] - so * g[1], so * g[0] + co * g[1]
            jacobian[k, r, 2] = g[0] * back_y - g[1] * back_x + g[2]


@compiled(inline="always")
def _along(rotation: Array, by_local: Row, scale: float) -> Row:
    """Gradient of a pixel coordinate by a point in the robot's axes."""
    a, b, c = scale * by_local[0], scale * by_local[1], scale * by_local[2]
    return (
        a * rotation[0, 0] + b * rotation[0, 1] + c * rotation[0, 2],
        a * rotation[1, 0] + b * rotation[1, 1] + c * rotation[1, 2],
        a * rotation[2, 0] + b * rotation[2, 1] + c * rotation[2, 2],
    )
