"""Compiled :mod:`factors.se2` for single poses, by components."""

import math

import numpy as np

from factors.compiled import compiled
from factors.se2 import Array

SMALL = 1e-4  # rad; smaller angles use series, against cancellation
SHORT = 0.5  # rad; of many poses smaller angles use longer series, in less time


@compiled
def wrapped(angle: float) -> float:
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


@compiled
def arc(angle: float) -> tuple[float, float]:
    """``sin(angle) / angle`` and ``(1 - cos(angle)) / angle``."""
    if abs(angle) < SMALL:
        return 1.0 - angle * angle / 6.0, angle / 2.0
    return math.sin(angle) / angle, 2.0 * math.sin(angle / 2.0) ** 2 / angle


@compiled(inline="always")
def _arc_of_many(angle: float) -> tuple[float, float]:
    """:func:`arc` to 1e-12."""
    if abs(angle) > SHORT:
        return math.sin(angle) / angle, 2.0 * math.sin(angle / 2.0) ** 2 / angle
    z = angle * angle
    p = 1.0 - z / 6 * (1.0 - z / 20 * (1.0 - z / 42 * (1.0 - z / 72 * (1.0 - z / 110))))
    q = angle / 2 * (1.0 - z / 12 * (1.0 - z / 30 * (1.0 - z / 56 * (1.0 - z / 90 * (1.0 - z / 132)))))
    return p, q


@compiled(inline="always")
def _wrapped_of_many(angle: float) -> float:
    return angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))


@compiled
def exp(x: float, y: float, angle: float) -> tuple[float, float, float]:
    p, q = arc(angle)
    return p * x - q * y, q * x + p * y, wrapped(angle)


@compiled
def log(x: float, y: float, heading: float) -> tuple[float, float, float]:
    angle = wrapped(heading)
    p, q = arc(angle)
    scale = 1.0 / (p * p + q * q)
    return scale * (p * x + q * y), scale * (p * y - q * x), angle


@compiled
def composed(x: float, y: float, heading: float, dx: float, dy: float, turned: float) -> tuple[float, float, float]:
    """The pose (dx, dy, turned) in the frame of another one."""
    c, s = math.cos(heading), math.sin(heading)
    return x + c * dx - s * dy, y + s * dx + c * dy, wrapped(heading + turned)


@compiled
def related(x: float, y: float, heading: float, to_x: float, to_y: float, to: float) -> tuple[float, float, float]:
    """The pose (to_x, to_y, to) as seen from another one."""
    c, s, dx, dy = math.cos(heading), math.sin(heading), to_x - x, to_y - y
    return c * dx + s * dy, c * dy - s * dx, wrapped(to - heading)


@compiled
def moved(pose: Array, twist: Array) -> Array:
    """The pose (3,) moved by a twist in its own frame, of which the first three components are read."""
    x, y, turned = exp(twist[0], twist[1], twist[2])
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array((pose[0] + c * x - s * y, pose[1] + s * x + c * y, wrapped(pose[2] + turned)))


@compiled
def twist_to(pose: Array, other: Array) -> Array:
    """The twist (3,) in the frame of a pose (3,) that leads from it to another: the inverse of :func:`moved`."""
    x, y, turned = related(pose[0], pose[1], pose[2], other[0], other[1], other[2])
    return np.array(log(x, y, turned))


@compiled
def compose(a: Array, b: Array) -> Array:
    """:func:`factors.se2.compose` of two poses (3,)."""
    return np.array(composed(a[0], a[1], a[2], b[0], b[1], b[2]))


@compiled
def between(a: Array, b: Array) -> Array:
    """:func:`factors.se2.between` of two poses (3,)."""
    return np.array(related(a[0], a[1], a[2], b[0], b[1], b[2]))


@compiled
def adjoint(pose: Array) -> Array:
    """:func:`factors.se2.adjoint` of one pose (3,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array(((c, -s, pose[1]), (s, c, -pose[0]), (0.0, 0.0, 1.0)))


@compiled
def right_jacobian(xi: Array) -> Array:
    """:func:`factors.se2.right_jacobian` of one twist (3,)."""
    angle = xi[2]
    p, q = arc(angle)
    r, s = (angle / 6.0, 0.5 - angle * angle / 24.0) if abs(angle) < SMALL else ((1.0 - p) / angle, q / angle)
    return np.array(((p, q, r * xi[0] - s * xi[1]), (-q, p, s * xi[0] + r * xi[1]), (0.0, 0.0, 1.0)))


@compiled
def inverse_right_jacobian(xi: Array) -> Array:
    """The inverse (3, 3) of :func:`right_jacobian`."""
    j = right_jacobian(xi)
    p, q, u, v = j[0, 0], j[0, 1], j[0, 2], j[1, 2]
    scale = 1.0 / (p * p + q * q)
    first = scale * p, -scale * q, -scale * (p * u - q * v)
    return np.array((first, (scale * q, scale * p, -scale * (q * u + p * v)), (0.0, 0.0, 1.0)))


@compiled
def body_to_world(pose: Array, covariance: Array) -> Array:
    """:func:`factors.se2.body_to_world` of one pose (3,), and of the first three components of a covariance (S, S), of which the
    upper triangle is read: the result is symmetric to the last bit."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    out = np.empty((3, 3))
    a, b, e = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    p, q, r, t = c * a - s * b, c * b - s * e, s * a + c * b, s * b + c * e
    out[0, 0], out[1, 1], out[2, 2] = p * c - q * s, r * s + t * c, covariance[2, 2]
    out[0, 1] = out[1, 0] = p * s + q * c
    out[0, 2] = out[2, 0] = c * covariance[0, 2] - s * covariance[1, 2]
    out[1, 2] = out[2, 1] = s * covariance[0, 2] + c * covariance[1, 2]
    return out


@compiled(error_model="numpy", fastmath={"arcp", "contract", "reassoc"})
def all_moved(poses: Array, delta: Array, twists: Array) -> Array:
    """Poses (N, 3) composed with ``delta`` (3,), and each then moved by a twist (N, 3) in its own frame."""
    out, cd, sd = np.empty_like(poses), math.cos(delta[2]), math.sin(delta[2])
    for n in range(len(poses)):
        c, s = math.cos(poses[n, 2]), math.sin(poses[n, 2])
        p, q = _arc_of_many(twists[n, 2])
        x, y = p * twists[n, 0] - q * twists[n, 1], q * twists[n, 0] + p * twists[n, 1]
        dx, dy = delta[0] + cd * x - sd * y, delta[1] + sd * x + cd * y
        out[n, 0], out[n, 1] = poses[n, 0] + c * dx - s * dy, poses[n, 1] + s * dx + c * dy
        out[n, 2] = _wrapped_of_many(poses[n, 2] + delta[2] + twists[n, 2])
    return out


@compiled(error_model="numpy", fastmath={"arcp", "contract", "reassoc"})
def twists_to(pose: Array, others: Array) -> Array:
    """The twists (N, 3) in the frame of a pose (3,) that lead from it to others (N, 3)."""
    out, c, s = np.empty_like(others), math.cos(pose[2]), math.sin(pose[2])
    for n in range(len(others)):
        dx, dy = others[n, 0] - pose[0], others[n, 1] - pose[1]
        angle = _wrapped_of_many(others[n, 2] - pose[2])
        p, q = _arc_of_many(angle)
        x, y, scale = c * dx + s * dy, c * dy - s * dx, 1.0 / (p * p + q * q)
        out[n, 0], out[n, 1], out[n, 2] = scale * (p * x + q * y), scale * (p * y - q * x), angle
    return out


@compiled(error_model="numpy", fastmath={"reassoc", "contract"})
def moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean (3,), circular in heading, and covariance (3, 3) of poses (N, 3) in the world's frame."""
    x = y = cosine = sine = 0.0
    for n in range(len(poses)):
        x, y = x + weights[n] * poses[n, 0], y + weights[n] * poses[n, 1]
        cosine, sine = cosine + weights[n] * math.cos(poses[n, 2]), sine + weights[n] * math.sin(poses[n, 2])
    heading, covariance = math.atan2(sine, cosine), np.zeros((3, 3))
    xx = xy = xh = yy = yh = hh = 0.0
    for n in range(len(poses)):
        dx, dy, dh = poses[n, 0] - x, poses[n, 1] - y, _wrapped_of_many(poses[n, 2] - heading)
        wx, wy, wh = weights[n] * dx, weights[n] * dy, weights[n] * dh
        xx, xy, xh = xx + wx * dx, xy + wx * dy, xh + wx * dh
        yy, yh, hh = yy + wy * dy, yh + wy * dh, hh + wh * dh
    covariance[0, 0], covariance[1, 1], covariance[2, 2] = xx, yy, hh
    covariance[0, 1] = covariance[1, 0] = xy
    covariance[0, 2] = covariance[2, 0] = xh
    covariance[1, 2] = covariance[2, 1] = yh
    return np.array((x, y, heading)), covariance
