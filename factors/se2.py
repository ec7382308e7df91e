"""The group SE(2) of planar poses, on arrays.

A pose is ``(x, y, heading)``: metres, metres, radians counter-clockwise. A tangent vector ``xi`` is a body-frame twist
``(rho_x, rho_y, phi)``, applied on the right: ``pose * exp(xi)``. This is also GTSAM's convention for ``Pose2``.
Formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendix A (eqs. 153 to 166).

All functions broadcast over leading axes, ``(..., 3)``.
"""

import math

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]


Array = NDArray[np.float64]

_SMALL_ANGLE = 1e-4


def wrap(angle: Array) -> Array:
    """Angles in radians, wrapped to (-pi, pi]."""
    return np.pi - np.mod(np.pi - np.asarray(angle, dtype=float), 2.0 * np.pi)


def wrap_scalar(angle: float) -> float:
    """One angle in radians, wrapped to (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


def compose(a: Array, b: Array) -> Array:
    """The pose ``a * b``: ``b``, given in the frame of ``a``, expressed in the frame of ``a``'s parent."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if a.ndim == b.ndim == 1:
        return np.array(_compose_one(*a.tolist(), *b.tolist()))
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    out[..., 0] = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    out[..., 1] = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    out[..., 2] = wrap(a[..., 2] + b[..., 2])
    return out


def inverse(a: Array) -> Array:
    """The pose ``a^-1``."""
    a = np.asarray(a, dtype=float)
    if a.ndim == 1:
        return np.array(_inverse_one(*a.tolist()))
    out = np.empty_like(a)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    out[..., 0] = -c * a[..., 0] - s * a[..., 1]
    out[..., 1] = s * a[..., 0] - c * a[..., 1]
    out[..., 2] = wrap(-a[..., 2])
    return out


def between(a: Array, b: Array) -> Array:
    """The pose of ``b`` in the frame of ``a``: ``a^-1 * b``."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if a.ndim == b.ndim == 1:
        return np.array(_compose_one(*_inverse_one(*a.tolist()), *b.tolist()))
    return compose(inverse(a), b)


def exp(xi: Array) -> Array:
    """The pose reached by following the twist ``xi`` for unit time: an arc of a circle."""
    xi = np.asarray(xi, dtype=float)
    if xi.ndim == 1:
        x, y, phi = xi.tolist()
        p, q = arc_coefficients(phi)
        return np.array((p * x - q * y, q * x + p * y, wrap_scalar(phi)))
    out = np.empty_like(xi)
    a, b = _arc_coefficients(xi[..., 2])
    out[..., 0] = a * xi[..., 0] - b * xi[..., 1]
    out[..., 1] = b * xi[..., 0] + a * xi[..., 1]
    out[..., 2] = wrap(xi[..., 2])
    return out


def log(pose: Array) -> Array:
    """The twist that leads from the origin to ``pose`` in unit time; the inverse of :func:`exp` for |heading| < pi."""
    pose = np.asarray(pose, dtype=float)
    if pose.ndim == 1:
        x, y, heading = pose.tolist()
        phi_one = wrap_scalar(heading)
        p, q = arc_coefficients(phi_one)
        d = p * p + q * q
        return np.array(((p * x + q * y) / d, (p * y - q * x) / d, phi_one))
    out = np.empty_like(pose)
    phi = wrap(pose[..., 2])
    a, b = _arc_coefficients(phi)
    det = a * a + b * b
    out[..., 0] = (a * pose[..., 0] + b * pose[..., 1]) / det
    out[..., 1] = (a * pose[..., 1] - b * pose[..., 0]) / det
    out[..., 2] = phi
    return out


def adjoint(pose: Array) -> Array:
    """The adjoint matrix ``(..., 3, 3)``: ``pose * exp(xi) = exp(adjoint(pose) xi) * pose``."""
    pose = np.asarray(pose, dtype=float)
    if pose.ndim == 1:
        x, y, heading = pose.tolist()
        cos, sin = math.cos(heading), math.sin(heading)
        return np.array(((cos, -sin, y), (sin, cos, -x), (0.0, 0.0, 1.0)))
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    out = np.zeros((*pose.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = c, -s, pose[..., 1]
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = s, c, -pose[..., 0]
    out[..., 2, 2] = 1.0
    return out


def right_jacobian(xi: Array) -> Array:
    """Right Jacobian ``(..., 3, 3)`` of :func:`exp`: ``exp(xi + d) ~ exp(xi) * exp(right_jacobian(xi) d)``."""
    xi = np.asarray(xi, dtype=float)
    if xi.ndim == 1:
        x, y, angle = xi.tolist()
        p, q = arc_coefficients(angle)
        r, s = (angle / 6.0, 0.5 - angle**2 / 24.0) if abs(angle) < _SMALL_ANGLE else ((1.0 - p) / angle, q / angle)
        return np.array(((p, q, r * x - s * y), (-q, p, s * x + r * y), (0.0, 0.0, 1.0)))
    phi = xi[..., 2]
    a, b = _arc_coefficients(phi)
    small = np.abs(phi) < _SMALL_ANGLE
    safe = np.where(small, 1.0, phi)
    # (1 - a) / phi and b / phi, with their series at zero
    c = np.where(small, phi / 6.0, (1.0 - a) / safe)
    d = np.where(small, 0.5 - phi**2 / 24.0, b / safe)
    out = np.zeros((*xi.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1] = a, b
    out[..., 1, 0], out[..., 1, 1] = -b, a
    out[..., 0, 2] = c * xi[..., 0] - d * xi[..., 1]
    out[..., 1, 2] = d * xi[..., 0] + c * xi[..., 1]
    out[..., 2, 2] = 1.0
    return out


def transform_to(pose: Array, points: Array) -> Array:
    """Points ``(..., 2)`` of the parent frame, expressed in the frame of ``pose``."""
    pose, points = np.asarray(pose, dtype=float), np.asarray(points, dtype=float)
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    dx, dy = points[..., 0] - pose[..., 0], points[..., 1] - pose[..., 1]
    out = np.empty((*np.shape(dx), 2))
    out[..., 0] = c * dx + s * dy
    out[..., 1] = c * dy - s * dx
    return out


def transform_from(pose: Array, points: Array) -> Array:
    """Points ``(..., 2)`` in the frame of ``pose``, expressed in the parent frame; the inverse of :func:`transform_to`."""
    pose, points = np.asarray(pose, dtype=float), np.asarray(points, dtype=float)
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + c * points[..., 0] - s * points[..., 1]
    y = pose[..., 1] + s * points[..., 0] + c * points[..., 1]
    return np.stack((x, y), axis=-1)


def body_to_world(pose: Array, covariance: Array) -> Array:
    """Convert a covariance ``(..., 3, 3)`` of the body-frame perturbation to one of ``(x, y, heading)`` in the world."""
    rotation = _rotation3(np.asarray(pose, dtype=float)[..., 2])
    return rotation @ covariance @ rotation.mT


def world_to_body(pose: Array, covariance: Array) -> Array:
    """Convert a covariance ``(..., 3, 3)`` of ``(x, y, heading)`` in the world to one of the body-frame perturbation."""
    rotation = _rotation3(np.asarray(pose, dtype=float)[..., 2])
    return rotation.mT @ covariance @ rotation


def arc_coefficients(phi: float) -> tuple[float, float]:
    """``sin(phi) / phi`` and ``(1 - cos(phi)) / phi`` of one angle."""
    if abs(phi) < _SMALL_ANGLE:
        return 1.0 - phi * phi / 6.0, phi / 2.0
    return math.sin(phi) / phi, 2.0 * math.sin(phi / 2.0) ** 2 / phi


def _arc_coefficients(phi: Array) -> tuple[Array, Array]:
    """:func:`arc_coefficients` of arrays."""
    small = np.abs(phi) < _SMALL_ANGLE
    safe = np.where(small, 1.0, phi)
    a = np.where(small, 1.0 - phi**2 / 6.0, np.sin(safe) / safe)
    # 1 - cos(phi) by the half angle, against cancellation
    b = np.where(small, phi / 2.0, 2.0 * np.sin(safe / 2.0) ** 2 / safe)
    return a, b


def _compose_one(ax: float, ay: float, ah: float, bx: float, by: float, bh: float) -> tuple[float, float, float]:
    # single poses are composed hundreds of thousands of times per run, for which numpy is ten times slower
    c, s = math.cos(ah), math.sin(ah)
    return ax + c * bx - s * by, ay + s * bx + c * by, wrap_scalar(ah + bh)


def _inverse_one(x: float, y: float, heading: float) -> tuple[float, float, float]:
    c, s = math.cos(heading), math.sin(heading)
    return -c * x - s * y, s * x - c * y, wrap_scalar(-heading)


def _rotation3(heading: Array) -> Array:
    if np.ndim(heading) == 0:
        cos, sin = math.cos(heading), math.sin(heading)
        return np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))
    c, s = np.cos(heading), np.sin(heading)
    out = np.zeros((*np.shape(heading), 3, 3))
    out[..., 0, 0], out[..., 0, 1] = c, -s
    out[..., 1, 0], out[..., 1, 1] = s, c
    out[..., 2, 2] = 1.0
    return out
