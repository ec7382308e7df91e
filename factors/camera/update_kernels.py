"""Known points in an image, compiled: a factor of :mod:`factors.camera.factor` on the pose and the tilt of the robot."""

import math
from typing import NamedTuple

import numpy as np

from factors.camera.kernels import POINT, TILT, WIDTH, Lens, project_planar
from factors.compiled import compiled
from factors.gaussian import inverse, put
from factors.robust import huber_weight
from factors.se2 import Array, between_one, compose_one
from factors.update import corrected

Row = tuple[float, float, float]
REWEIGHTED, STILL = 50, 1e-5  # most rounds to find a tilt, and standard deviations that the last may change it


class PackedImage(NamedTuple):
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
def whitened(image: PackedImage, pose: Array, width: int = POINT) -> tuple[Array, Array]:
    """See :meth:`~factors.camera.factor.ReprojectionFactor.whitened`: residual (K, 2), and the first ``width`` columns of its
    Jacobian (K, 2, WIDTH) by the pose (3), by the tilt (2) in standard deviations, by the point (3) and by the camera's constants
    (8), without a time offset."""
    count, row = len(image.points), np.empty((2, WIDTH))
    residual, jacobian = np.empty((count, 2)), np.empty((count, 2, width))
    camera, scale = (image.lens, image.position, image.rotation), 1.0 / image.sigma
    at, level, upright = compose_one(pose, image.offset), np.zeros(2), np.eye(3)
    # of the variable's pose, seen from the pose of the image
    back = between_one(image.offset, np.zeros(3))
    co, so = math.cos(image.offset[2]), math.sin(image.offset[2])
    exact, common = len(image.point_covariances) == 0, np.trace(image.offset_covariance) > 0.0
    for k in range(count):
        u, v, _ = project_planar(camera, at, level, upright, image.points[k], row)
        eu, ev = scale * (u - image.pixels[k, 0]), scale * (v - image.pixels[k, 1])
        for r in range(2):
            for j in range(WIDTH):
                row[r, j] *= image.tilt * scale if TILT <= j < POINT else scale
        if common or not exact:
            uu, uv, vv = 1.0, 0.0, 1.0
            if not exact:
                uu, uv, vv = _widened(image.point_covariances[k], row, POINT, 1.0, uu, uv, vv)
            if common:  # this error is common to all points, so it must not average out
                uu, uv, vv = _widened(image.offset_covariance, row, 0, float(count), uu, uv, vv)
            # by the inverse of the lower root (a, 0; b, d)
            a = math.sqrt(uu)
            b = uv / a
            d = math.sqrt(vv - b * b)
            eu = eu / a
            ev = (ev - b * eu) / d
            for j in range(WIDTH):
                row[0, j] /= a
                row[1, j] = (row[1, j] - b * row[0, j]) / d
        residual[k, 0], residual[k, 1] = eu, ev
        for r in range(2):
            gx, gy = row[r, 0], row[r, 1]
            row[r, 0], row[r, 1] = co * gx - so * gy, so * gx + co * gy
            row[r, 2] += gx * back[1] - gy * back[0]
            for j in range(width):
                jacobian[k, r, j] = row[r, j]
    return residual, jacobian


@compiled(inline="always")
def _widened(
    covariance: Array, row: Array, first: int, count: float, uu: float, uv: float, vv: float
) -> tuple[float, float, float]:
    """The covariance (uu, uv, vv) of a pixel, plus ``count`` times that of three variables, whose columns begin at ``first``."""
    p = row[0, first], row[0, first + 1], row[0, first + 2]
    q = row[1, first], row[1, first + 1], row[1, first + 2]
    uu, uv = uu + count * _product(covariance, p, p), uv + count * _product(covariance, p, q)
    return uu, uv, vv + count * _product(covariance, q, q)


@compiled(error_model="numpy")
def linearized(image: PackedImage, pose: Array) -> tuple[Array, Array]:
    """See :meth:`~factors.camera.factor.ReprojectionFactor.linearize`: residual (2K,) and Jacobian (2K, 3)."""
    residual, jacobian = whitened(image, pose)
    return marginal(residual, jacobian, image.robust, image.tempering)


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
def leaning(image: PackedImage, pose: Array, covariance: Array) -> tuple[Array, Array]:
    """Roll and pitch (2,) [rad] of a robot at a ``pose`` (3,) with this ``covariance`` (3, 3), as least squares find them in an
    image, and their covariance (2, 2)."""
    residual, jacobian = whitened(image, pose)
    prior = np.eye(POINT)
    put(inverse(covariance), prior)
    known = np.arange(POINT), np.ones(len(residual)), np.zeros(POINT)
    delta, posterior, _ = corrected(prior, residual, jacobian, *known)
    return image.tilt * delta[3:], image.tilt**2 * posterior[3:, 3:]


@compiled(error_model="numpy")
def placed(position: Array, rotation: Array, tilt: float, pose: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """Position (3,) and rotation (3, 3) in the world of a camera mounted at ``position`` with ``rotation`` on a robot at ``pose``
    (3,), and the covariance (6, 6) of its perturbation in its own frame, rotation first, from ``covariance`` (3, 3) of the pose
    and the standard deviation ``tilt`` [rad] of roll and pitch."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    where, turned, lift, carried = np.empty(3), np.empty((3, 3)), np.zeros((6, POINT)), np.empty((6, 6))
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
def pixel_noise(by_point: Array, covariances: Array, sigma: float) -> Array:
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
