"""The group SE(2) of planar poses, on arrays.

A pose is ``(x, y, heading)``: metres, metres, radians counter-clockwise. A tangent vector ``xi`` is a body-frame twist
``(rho_x, rho_y, phi)``, applied on the right: ``pose * exp(xi)``. This is also GTSAM's convention for ``Pose2``.
Formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendix A (eqs. 153 to 166).

Functions of arrays broadcast over leading axes, ``(..., 3)``. The compiled functions take numbers (``_scalars``), one
pose (``_one``), or many poses. Compiled code and filters call them, because NumPy is slow for single poses.
"""

import math

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from factors.compiled import compiled

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

SMALL = 1e-4  # rad; functions of smaller angles use a Taylor series, to avoid cancellation
SHORT = 0.5  # rad; functions of many poses use a longer Taylor series below this angle, because it is faster


def wrap(angle: Array) -> Array:
    """Return angles [rad], wrapped to (-pi, pi]."""
    return np.pi - np.mod(np.pi - np.asarray(angle, dtype=float), 2.0 * np.pi)


@register_jitable
def wrap_scalar(angle: float) -> float:
    """Return one angle [rad], wrapped to (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


def compose(a: Array, b: Array) -> Array:
    """Return the pose ``a * b`` (..., 3): ``b`` is given in the frame of ``a``, the result in the parent of ``a``."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if a.ndim == b.ndim == 1:
        return np.array(compose_scalars(*a.tolist(), *b.tolist()))
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    out[..., 0] = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    out[..., 1] = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    out[..., 2] = wrap(a[..., 2] + b[..., 2])
    return out


def inverse(a: Array) -> Array:
    """Return the pose ``a^-1`` (..., 3), the parent frame in the frame of ``a``."""
    a = np.asarray(a, dtype=float)
    if a.ndim == 1:
        x, y, heading = a.tolist()
        return np.array(between_scalars(x, y, heading, 0.0, 0.0, 0.0))
    out = np.empty_like(a)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    out[..., 0] = -c * a[..., 0] - s * a[..., 1]
    out[..., 1] = s * a[..., 0] - c * a[..., 1]
    out[..., 2] = wrap(-a[..., 2])
    return out


def between(a: Array, b: Array) -> Array:
    """Return the pose ``a^-1 * b`` (..., 3), which is ``b`` in the frame of ``a``."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if a.ndim == b.ndim == 1:
        return np.array(between_scalars(*a.tolist(), *b.tolist()))
    return compose(inverse(a), b)


def exp(xi: Array) -> Array:
    """Return the pose (..., 3) after following the twist ``xi`` (..., 3) for unit time: an arc of a circle."""
    xi = np.asarray(xi, dtype=float)
    if xi.ndim == 1:
        return np.array(exp_scalars(*xi.tolist()))
    out = np.empty_like(xi)
    a, b = _arc_coefficients(xi[..., 2])
    out[..., 0] = a * xi[..., 0] - b * xi[..., 1]
    out[..., 1] = b * xi[..., 0] + a * xi[..., 1]
    out[..., 2] = wrap(xi[..., 2])
    return out


def log(pose: Array) -> Array:
    """Return the twist (..., 3) from the origin to ``pose`` in unit time. Inverse of :func:`exp` for |heading| < pi."""
    pose = np.asarray(pose, dtype=float)
    if pose.ndim == 1:
        return np.array(log_scalars(*pose.tolist()))
    out = np.empty_like(pose)
    phi = wrap(pose[..., 2])
    a, b = _arc_coefficients(phi)
    det = a * a + b * b
    out[..., 0] = (a * pose[..., 0] + b * pose[..., 1]) / det
    out[..., 1] = (a * pose[..., 1] - b * pose[..., 0]) / det
    out[..., 2] = phi
    return out


def adjoint(pose: Array) -> Array:
    """Return the adjoint matrix A (..., 3, 3) of a pose: ``pose * exp(xi) = exp(A xi) * pose`` for a twist ``xi``."""
    pose = np.asarray(pose, dtype=float)
    out = _rotation3(pose[..., 2])
    out[..., 0, 2], out[..., 1, 2] = pose[..., 1], -pose[..., 0]
    return out


def transform_to(pose: Array, points: Array) -> Array:
    """Return ``points`` (..., 2) of the parent frame, expressed in the frame of ``pose``."""
    pose, points = np.asarray(pose, dtype=float), np.asarray(points, dtype=float)
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    dx, dy = points[..., 0] - pose[..., 0], points[..., 1] - pose[..., 1]
    out = np.empty((*np.shape(dx), 2))
    out[..., 0] = c * dx + s * dy
    out[..., 1] = c * dy - s * dx
    return out


def transform_from(pose: Array, points: Array) -> Array:
    """Return ``points`` (..., 2) of the frame of ``pose`` in the parent frame, the inverse of :func:`transform_to`."""
    pose, points = np.asarray(pose, dtype=float), np.asarray(points, dtype=float)
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + c * points[..., 0] - s * points[..., 1]
    y = pose[..., 1] + s * points[..., 0] + c * points[..., 1]
    return np.stack((x, y), axis=-1)


def align_points(points: Array, targets: Array) -> Array:
    """Return the pose (3,) that moves ``points`` (N, 2) onto ``targets`` (N, 2) with the least squared distances.

    Pairs that contain a NaN are ignored. If no pair is left, the result is NaN. If all points coincide, the rotation is
    0. Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 13(4),
    1991, equations 40 to 42 with scale 1. In the plane the rotation is one angle.
    """
    known = np.isfinite(points).all(axis=1) & np.isfinite(targets).all(axis=1)
    if not known.any():
        return np.full(3, np.nan)
    centre, target_centre = points[known].mean(axis=0), targets[known].mean(axis=0)
    a, b = points[known] - centre, targets[known] - target_centre
    angle = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    rotation = np.array((0.0, 0.0, angle))
    return np.array((*(target_centre - transform_from(rotation, centre)), angle))


def body_to_world(pose: Array, covariance: Array) -> Array:
    """Return the covariance (..., 3, 3) of (x, y, heading) in the world, from the body-frame one at ``pose``."""
    rotation = _rotation3(np.asarray(pose, dtype=float)[..., 2])
    return rotation @ covariance @ rotation.mT


def world_to_body(pose: Array, covariance: Array) -> Array:
    """Return the body-frame covariance (..., 3, 3) at ``pose``, from that of (x, y, heading) in the world."""
    rotation = _rotation3(np.asarray(pose, dtype=float)[..., 2])
    return rotation.mT @ covariance @ rotation


@register_jitable
def arc_coefficients(phi: float) -> tuple[float, float]:
    """Return ``sin(phi) / phi`` and ``(1 - cos(phi)) / phi`` of one angle [rad]. Compiled code may call it."""
    if abs(phi) < SMALL:
        return 1.0 - phi * phi / 6.0, phi / 2.0
    return math.sin(phi) / phi, 2.0 * math.sin(phi / 2.0) ** 2 / phi


def _arc_coefficients(phi: Array) -> tuple[Array, Array]:
    """Return ``sin(phi) / phi`` and ``(1 - cos(phi)) / phi`` of an array of angles ``phi``."""
    small = np.abs(phi) < SMALL
    safe = np.where(small, 1.0, phi)
    a = np.where(small, 1.0 - phi**2 / 6.0, np.sin(safe) / safe)
    # 1 - cos(phi) = 2 sin(phi / 2)^2, without cancellation
    b = np.where(small, phi / 2.0, 2.0 * np.sin(safe / 2.0) ** 2 / safe)
    return a, b


def _rotation3(heading: Array) -> Array:
    """Return the matrices (..., 3, 3) that rotate the first two components by ``heading`` (...) and keep the third."""
    if np.ndim(heading) == 0:
        cos, sin = math.cos(heading), math.sin(heading)
        return np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))
    c, s = np.cos(heading), np.sin(heading)
    out = np.zeros((*np.shape(heading), 3, 3))
    out[..., 0, 0], out[..., 0, 1] = c, -s
    out[..., 1, 0], out[..., 1, 1] = s, c
    out[..., 2, 2] = 1.0
    return out


@compiled(inline="always")
def _arc_of_many(angle: float) -> tuple[float, float]:
    """Return the results of :func:`arc_coefficients` in less time, with an error of at most 1e-12."""
    if abs(angle) > SHORT:
        return math.sin(angle) / angle, 2.0 * math.sin(angle / 2.0) ** 2 / angle
    z = angle * angle
    p = 1.0 - z / 6 * (1.0 - z / 20 * (1.0 - z / 42 * (1.0 - z / 72 * (1.0 - z / 110))))
    q = angle / 2 * (1.0 - z / 12 * (1.0 - z / 30 * (1.0 - z / 56 * (1.0 - z / 90 * (1.0 - z / 132)))))
    return p, q


@compiled(inline="always")
def _wrapped_of_many(angle: float) -> float:
    """Return one angle [rad], wrapped to (-pi, pi], in less time than :func:`wrap_scalar`."""
    return angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))


@compiled
def exp_scalars(x: float, y: float, angle: float) -> tuple[float, float, float]:
    """Return the pose (x, y, heading) after following the twist (``x``, ``y``, ``angle``) for unit time."""
    p, q = arc_coefficients(angle)
    return p * x - q * y, q * x + p * y, wrap_scalar(angle)


@compiled
def log_scalars(x: float, y: float, heading: float) -> tuple[float, float, float]:
    """Return the twist (x, y, angle) from the origin to the pose (``x``, ``y``, ``heading``) in unit time."""
    angle = wrap_scalar(heading)
    p, q = arc_coefficients(angle)
    scale = 1.0 / (p * p + q * q)
    return scale * (p * x + q * y), scale * (p * y - q * x), angle


@compiled
def compose_scalars(
    x: float, y: float, heading: float, dx: float, dy: float, turned: float
) -> tuple[float, float, float]:
    """Return the product (x, y, heading) of the poses (``x``, ``y``, ``heading``) and (``dx``, ``dy``, ``turned``)."""
    c, s = math.cos(heading), math.sin(heading)
    return x + c * dx - s * dy, y + s * dx + c * dy, wrap_scalar(heading + turned)


@compiled
def between_scalars(
    x: float, y: float, heading: float, to_x: float, to_y: float, to: float
) -> tuple[float, float, float]:
    """Return the pose (``to_x``, ``to_y``, ``to``) in the frame of the pose (``x``, ``y``, ``heading``)."""
    c, s, dx, dy = math.cos(heading), math.sin(heading), to_x - x, to_y - y
    return c * dx + s * dy, c * dy - s * dx, wrap_scalar(to - heading)


@compiled
def moved(pose: Array, twist: Array) -> Array:
    """Return ``pose * exp(twist)``: the pose (3,) moved by a twist in its frame, the first 3 elements of ``twist``."""
    x, y, turned = exp_scalars(twist[0], twist[1], twist[2])
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array((pose[0] + c * x - s * y, pose[1] + s * x + c * y, wrap_scalar(pose[2] + turned)))


@compiled
def twist_to(pose: Array, target: Array) -> Array:
    """Return the twist (3,), in the frame of ``pose`` (3,), that moves ``pose`` to ``target`` (3,)."""
    x, y, turned = between_scalars(pose[0], pose[1], pose[2], target[0], target[1], target[2])
    return np.array(log_scalars(x, y, turned))


@compiled
def compose_one(a: Array, b: Array) -> Array:
    """Return the pose ``a * b`` (3,) of two poses (3,), with ``b`` given in the frame of ``a``."""
    return np.array(compose_scalars(a[0], a[1], a[2], b[0], b[1], b[2]))


@compiled
def between_one(a: Array, b: Array) -> Array:
    """Return the pose ``a^-1 * b`` (3,) of two poses (3,), which is ``b`` in the frame of ``a``."""
    return np.array(between_scalars(a[0], a[1], a[2], b[0], b[1], b[2]))


@compiled
def right_jacobian(xi: Array) -> Array:
    """Return the right Jacobian J (3, 3) of :func:`exp` at one twist (3,): ``exp(xi + d) ~ exp(xi) * exp(J d)``."""
    angle = xi[2]
    p, q = arc_coefficients(angle)
    r, s = (angle / 6.0, 0.5 - angle * angle / 24.0) if abs(angle) < SMALL else ((1.0 - p) / angle, q / angle)
    return np.array(((p, q, r * xi[0] - s * xi[1]), (-q, p, s * xi[0] + r * xi[1]), (0.0, 0.0, 1.0)))


@compiled
def inverse_right_jacobian(xi: Array) -> Array:
    """Return the inverse (3, 3) of the right Jacobian of :func:`exp` at one twist ``xi`` (3,)."""
    j = right_jacobian(xi)
    p, q, u, v = j[0, 0], j[0, 1], j[0, 2], j[1, 2]
    scale = 1.0 / (p * p + q * q)
    first = scale * p, -scale * q, -scale * (p * u - q * v)
    return np.array((first, (scale * q, scale * p, -scale * (q * u + p * v)), (0.0, 0.0, 1.0)))


@compiled
def body_to_world_one(pose: Array, covariance: Array) -> Array:
    """Return the covariance (3, 3) of (x, y, heading) in the world, from the body-frame covariance of one pose (3,).
    ``covariance`` (S, S): its first three components are used. Elements below its diagonal are ignored."""
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
    """Return ``poses * delta * exp(twists)`` (N, 3): ``poses`` (N, 3), each moved by the common motion ``delta`` (3,)
    and then by its own twist in ``twists`` (N, 3)."""
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
def twists_to(pose: Array, targets: Array) -> Array:
    """Return the twists (N, 3) that move ``pose`` (3,) to each of ``targets`` (N, 3), in the frame of ``pose``."""
    out, c, s = np.empty_like(targets), math.cos(pose[2]), math.sin(pose[2])
    for n in range(len(targets)):
        dx, dy = targets[n, 0] - pose[0], targets[n, 1] - pose[1]
        angle = _wrapped_of_many(targets[n, 2] - pose[2])
        p, q = _arc_of_many(angle)
        x, y, scale = c * dx + s * dy, c * dy - s * dx, 1.0 / (p * p + q * q)
        out[n, 0], out[n, 1], out[n, 2] = scale * (p * x + q * y), scale * (p * y - q * x), angle
    return out


@compiled(error_model="numpy", fastmath={"reassoc", "contract"})
def moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Return the weighted mean (3,) of poses (N, 3), and the covariance (3, 3) of (x, y, heading) in the world frame.
    The mean of the headings is circular. ``weights`` (N,): must have the sum 1."""
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
