"""Compiled functions for known points in an image: the linearisation of
:class:`~factors.camera.factor.ReprojectionFactor`, and the estimation of the robot's roll and pitch."""

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
# The maximum number of iterations to fit a tilt, and the change of the tilt, in standard deviations, that ends the iterations.
REWEIGHTED, STILL = 50, 1e-5


class PackedImage(NamedTuple):
    """A :class:`~factors.camera.factor.ReprojectionFactor` on the pose only, as a tuple for compiled code.

    ``lens``, ``position``, ``rotation``: the camera. ``points`` (K, 3): world points. ``pixels`` (K, 2): their pixels.
    ``point_covariances``: (K, 3, 3), or (0, 3, 3) for an exact map.
    ``offset`` (3,), ``offset_covariance`` (3, 3): zeros if these fields of the factor are None.
    ``sigma`` [px], ``robust``, ``tempering``: pixel noise, scale of Huber's loss and exponent of the likelihood.
    ``tilt`` [rad]: standard deviation of the robot's roll and pitch.
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
    """Return the whitened residual (K, 2) of a level robot at ``pose`` (3,), and its Jacobian (K, 2, width).

    ``image``: K points in an image. ``width``: the number of columns to compute. The columns of a full Jacobian are the
    pose (3), the tilt (2) in standard deviations, the point (3), and the camera's constants (8). The derivative by the
    time offset is zero.
    """
    count, row = len(image.points), np.empty((2, WIDTH))
    residual, jacobian = np.empty((count, 2)), np.empty((count, 2, width))
    camera, scale = (image.lens, image.position, image.rotation), 1.0 / image.sigma
    at, level, upright = compose_one(pose, image.offset), np.zeros(2), np.eye(3)
    # the estimated pose in the frame of the pose at the time of the image
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
            # multiply by the inverse of the lower Cholesky root [[a, 0], [b, d]] of the covariance
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
    """Add the effect of three uncertain variables to the covariance (uu, uv, vv) of a pixel.

    ``covariance`` (3, 3): covariance of the variables. ``row`` (2, WIDTH): the pixel's Jacobian. ``first``: the column
    of the first variable. ``count``: a factor of the added covariance. Returns the new uu, uv and vv.
    """
    p = row[0, first], row[0, first + 1], row[0, first + 2]
    q = row[1, first], row[1, first + 1], row[1, first + 2]
    uu, uv = uu + count * _product(covariance, p, p), uv + count * _product(covariance, p, q)
    return uu, uv, vv + count * _product(covariance, q, q)


@compiled(error_model="numpy")
def linearized(image: PackedImage, pose: Array) -> tuple[Array, Array]:
    """Return the whitened residual (2K,) of an image at ``pose`` (3,), and its Jacobian (2K, 3) by the pose. Both
    include robust weights and tempering. Roll and pitch are marginalised."""
    residual, jacobian = whitened(image, pose)
    return marginal(residual, jacobian, image.robust, image.tempering)


@compiled(error_model="numpy")
def tilted(residual: Array, by_tilt: Array, robust: float) -> tuple[float, float, Array]:
    """Fit the robot's roll and pitch to K points in an image, by iteratively reweighted least squares (a convex cost).

    ``residual`` (K, 2): the whitened residuals of a level robot. ``by_tilt`` (K, 2, 2): their Jacobian by roll and
    pitch in standard deviations. ``robust``: the scale of Huber's loss. Returns roll and pitch in standard deviations,
    and the robust weights (K,) at the solution.
    """
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
    """Marginalise the robot's roll and pitch, errors that all K points of an image have in common.

    ``residual`` (K, 2): whitened. ``jacobian`` (K, 2, D + 2): by D variables and, in the last two columns T, by roll
    and pitch in standard deviations. ``robust``: the scale of Huber's loss. ``tempering``: the exponent of the
    likelihood.
    Returns the residual (2K,) and its Jacobian (2K, D), whitened for a noise that includes roll and pitch.

    With the diagonal matrix W of robust weights, the covariance of the residuals is W^-1 + T T'. A square root of its
    inverse is (1 - A C A') W^(1/2), with A = W^(1/2) T, H^2 = 1 + A'A, and C^-1 = H (H + 1). The result is multiplied
    by the square root of the tempering.
    """
    n, size = len(residual), jacobian.shape[2] - 2
    _, _, weights = tilted(residual, jacobian[:, :, size:], robust)
    out = np.empty((2 * n, size + 3))  # columns: D variables, tilt (2), residual
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
    """Return the least-squares estimate (2,) [rad] of the robot's roll and pitch from one image, and its covariance (2,
    2). ``pose`` (3,), ``covariance`` (3, 3): the prediction of the robot pose."""
    residual, jacobian = whitened(image, pose)
    prior = np.eye(POINT)
    put(inverse(covariance), prior)
    known = np.arange(POINT), np.ones(len(residual)), np.zeros(POINT)
    delta, posterior, _ = corrected(prior, residual, jacobian, *known)
    return image.tilt * delta[3:], image.tilt**2 * posterior[3:, 3:]


@compiled(error_model="numpy")
def placed(position: Array, rotation: Array, tilt: float, pose: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """Return the pose of a camera in the world, with its covariance.

    ``position`` (3,), ``rotation`` (3, 3): the camera's pose in the robot frame.
    ``tilt`` [rad]: the standard deviation of the robot's roll and pitch.
    ``pose`` (3,), ``covariance`` (3, 3): the robot's planar pose, and its body-frame covariance.

    The results are the camera's position (3,) and rotation (3, 3) in the world, and a covariance (6, 6). It is that of
    the perturbation in the camera frame, with rotation before translation.
    """
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
    """Return the covariances (K, 2, 2) [px^2] of predicted minus measured pixels. ``by_point`` (K, 2, 3): the Jacobian
    of pixels by points. ``covariances`` (K, 3, 3): covariances of the points. ``sigma`` [px]: the pixel noise."""
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
    """Return the bilinear form ``p' matrix q`` of a matrix (3, 3)."""
    x = matrix[0, 0] * q[0] + matrix[0, 1] * q[1] + matrix[0, 2] * q[2]
    y = matrix[1, 0] * q[0] + matrix[1, 1] * q[1] + matrix[1, 2] * q[2]
    z = matrix[2, 0] * q[0] + matrix[2, 1] * q[1] + matrix[2, 2] * q[2]
    return float(p[0] * x + p[1] * y + p[2] * z)
