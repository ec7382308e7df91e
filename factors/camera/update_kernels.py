"""Compiled Kalman update by known points in an image.

Equal to the update in information form (:mod:`factors.update`) by a factor of :mod:`factors.camera.factor` on the pose. Compiled,
because an update uses a dozen small matrices, for which NumPy's overhead exceeds the arithmetic.
"""

import math
from typing import NamedTuple

import numpy as np

from factors.camera.kernels import Lens, in_camera, mounting, pixel
from factors.compiled import compiled
from factors.robust import huber_weight
from factors.se2 import Array
from factors.se2_kernels import exp
from factors.small_kernels import inverse

Row = tuple[float, float, float]


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


@compiled(error_model="numpy")
def whitened(seen: Seen, pose: Array) -> tuple[Array, Array]:
    """See :meth:`~factors.camera.factor.ReprojectionFactor.whitened`: residual (K, 2) and Jacobian (K, 2, 3)."""
    residual, jacobian = np.empty((len(seen.points), 2)), np.empty((len(seen.points), 2, 3))
    _whiten(seen, pose[0], pose[1], pose[2], residual, jacobian)
    return residual, jacobian


@compiled(error_model="numpy")
def linearized(seen: Seen, pose: Array) -> tuple[Array, Array]:
    """See :meth:`~factors.camera.factor.ReprojectionFactor.linearize`: residual (2K,) and Jacobian (2K, 3)."""
    residual, jacobian = whitened(seen, pose)
    for k in range(len(residual)):
        root = math.sqrt(_weight(seen, residual[k, 0] ** 2 + residual[k, 1] ** 2))
        for r in range(2):
            residual[k, r] *= root
            for j in range(3):
                jacobian[k, r, j] *= root
    return residual.reshape(-1), jacobian.reshape(-1, 3)


@compiled(error_model="numpy")
def updated(
    seen: Seen, pose: Array, covariance: Array, iterations: int, converged: float, gate: float
) -> tuple[Array, Array, Array, float]:
    """See :func:`~factors.update.robust_update`: correction (S,) and covariance (S, S) afterwards; whitened residuals (K, 2) at the
    prediction, and their normalised square. ``gate``: of a single point."""
    n, size = len(seen.points), len(covariance)
    prior = inverse(covariance)
    first, jacobian = np.empty((n, 2)), np.empty((n, 2, 3))
    _whiten(seen, pose[0], pose[1], pose[2], first, jacobian)
    weights, before = np.ones(n), np.zeros(size)
    delta, after, pull = _solved(prior, first, jacobian, weights, before)
    nis = 0.0
    for k in range(n):
        nis += first[k, 0] ** 2 + first[k, 1] ** 2
    for i in range(3):
        for j in range(3):
            nis -= pull[i] * after[i, j] * pull[j]
    widest = 1.0
    for k in range(n):
        widening = max(1.0, _normalised(first[k], jacobian[k], covariance) / gate)
        widest = max(widest, widening)
        weights[k] = seen.tempering / (widening * widening)
    if widest > 1.0 or seen.tempering < 1.0:
        delta, after, pull = _solved(prior, first, jacobian, weights, before)
    residual = np.empty((n, 2))
    for _ in range(iterations - 1):
        step = 0.0
        for i in range(size):
            step = max(step, abs(delta[i] - before[i]))
        if step < converged:
            break
        before = delta
        dx, dy, turned = exp(delta[0], delta[1], delta[2])
        c, s = math.cos(pose[2]), math.sin(pose[2])
        _whiten(seen, pose[0] + c * dx - s * dy, pose[1] + s * dx + c * dy, pose[2] + turned, residual, jacobian)
        for k in range(n):
            weights[k] = _weight(seen, residual[k, 0] ** 2 + residual[k, 1] ** 2)
        delta, after, pull = _solved(prior, residual, jacobian, weights, before)
    for i in range(size):
        for j in range(i):
            after[i, j] = after[j, i] = 0.5 * (after[i, j] + after[j, i])
    return delta, after, first, nis


@compiled(error_model="numpy")
def placed(position: Array, rotation: Array, pose: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """Position (3,) and rotation (3, 3) in the world of a camera mounted at ``position`` with ``rotation`` on a robot at ``pose``
    (3,), and the covariance (6, 6) of its perturbation in its own frame, rotation first, from ``covariance`` (3, 3) of the pose."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    where, turned, lift, carried = np.empty(3), np.empty((3, 3)), np.zeros((6, 3)), np.empty((6, 6))
    where[0] = pose[0] + c * position[0] - s * position[1]
    where[1] = pose[1] + s * position[0] + c * position[1]
    where[2] = position[2]
    for i in range(3):
        turned[0, i] = c * rotation[0, i] - s * rotation[1, i]
        turned[1, i] = s * rotation[0, i] + c * rotation[1, i]
        turned[2, i] = rotation[2, i]
        lift[i, 2] = rotation[2, i]
        lift[3 + i, 0], lift[3 + i, 1] = rotation[0, i], rotation[1, i]
        lift[3 + i, 2] = position[0] * rotation[1, i] - position[1] * rotation[0, i]
    for i in range(6):
        p = (lift[i, 0], lift[i, 1], lift[i, 2])
        for j in range(6):
            carried[i, j] = _product(covariance, p, (lift[j, 0], lift[j, 1], lift[j, 2]))
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


@compiled(inline="always")
def _weight(seen: Seen, squared: float) -> float:
    """The robust weight of a squared whitened residual, tempered."""
    return float(seen.tempering * huber_weight(squared, seen.robust))


@compiled(error_model="numpy")
def _whiten(seen: Seen, x: float, y: float, heading: float, residual: Array, jacobian: Array) -> None:
    """Whitened residuals (K, 2), predicted minus measured, and their Jacobians (K, 2, 3) by the pose (x, y, heading), in place."""
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
        residual[k, 0], residual[k, 1] = eu, ev
        for r in range(2):
            g = by_p if r == 0 else by_q
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


@compiled(error_model="numpy")
def _solved(
    prior: Array, residual: Array, jacobian: Array, weights: Array, at: Array
) -> tuple[Array, Array, tuple[float, float, float]]:
    """Correction (S,) and covariance (S, S) from weighted residuals (K, 2) linearised at the correction ``at`` (S,), and the
    gradient at the correction."""
    information = prior.copy()
    xx = xy = xa = yy = ya = aa = px = py = pa = 0.0
    for k in range(len(residual)):
        w = weights[k]
        for r in range(2):
            x, y, a = jacobian[k, r, 0], jacobian[k, r, 1], jacobian[k, r, 2]
            e = w * (x * at[0] + y * at[1] + a * at[2] - residual[k, r])
            xx, xy, xa = xx + w * x * x, xy + w * x * y, xa + w * x * a
            yy, ya, aa = yy + w * y * y, ya + w * y * a, aa + w * a * a
            px, py, pa = px + e * x, py + e * y, pa + e * a
    information[0, 0] += xx
    information[1, 1] += yy
    information[2, 2] += aa
    information[0, 1] += xy
    information[1, 0] += xy
    information[0, 2] += xa
    information[2, 0] += xa
    information[1, 2] += ya
    information[2, 1] += ya
    after = inverse(information)
    delta = np.empty(len(prior))
    for i in range(len(prior)):
        delta[i] = after[i, 0] * px + after[i, 1] * py + after[i, 2] * pa
    return delta, after, (px, py, pa)


@compiled(inline="always")
def _normalised(residual: Array, jacobian: Array, covariance: Array) -> float:
    """Normalised innovation squared of a single point."""
    p = (jacobian[0, 0], jacobian[0, 1], jacobian[0, 2])
    q = (jacobian[1, 0], jacobian[1, 1], jacobian[1, 2])
    a, b, c = 1.0 + _product(covariance, p, p), _product(covariance, p, q), 1.0 + _product(covariance, q, q)
    x, y = residual[0], residual[1]
    return float((c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b))
