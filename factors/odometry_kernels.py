"""The compiled part of the odometry's factor: graphs linearise it tens of thousands of times a run."""

from __future__ import annotations

import math

import numba
import numpy as np

from factors.se2 import Array

SMALL = 1e-4  # rad: below it series stand for what would lose its digits


@numba.njit(cache=True)
def recalibrate(arc: Array, duration: float, changes: Array) -> tuple[Array, Array]:
    """See :func:`factors.odometry.recalibrated`, of which ``arc`` (3,) is the logarithm of the increment."""
    x, y, phi = arc[0], arc[1], arc[2]
    way = math.hypot(x, y)
    cx, cy = x + changes[0] * x, y + changes[0] * y
    turn = phi + changes[1] * phi - changes[2] * duration + changes[3] * way
    p, q = _arc(turn)
    jacobian = _right_jacobian(cx, cy, turn)
    by_changes = np.zeros((3, 4))
    for i in range(3):
        by_changes[i, 0] = jacobian[i, 0] * x + jacobian[i, 1] * y
        by_changes[i, 1], by_changes[i, 2] = jacobian[i, 2] * phi, -jacobian[i, 2] * duration
        by_changes[i, 3] = jacobian[i, 2] * way
    return np.array((p * cx - q * cy, q * cx + p * cy, _wrapped(turn))), by_changes


@numba.njit(cache=True)
def linearize(
    start: Array, end: Array, delta: Array, by_changes: Array, whitener: Array
) -> tuple[Array, Array, Array, Array]:
    """Whitened residual (3,) ``log(delta^-1 * start^-1 * end)``, and its Jacobians by both poses (3, 3) and by what changes
    ``delta`` as ``by_changes`` (3, P) says, (3, P)."""
    rx, ry, turned = _between(start, end)
    relative = np.array((rx, ry, turned))
    ex, ey, angle = _between(delta, relative)
    p, q = _arc(angle)
    scale = 1.0 / (p * p + q * q)
    x, y = scale * (p * ex + q * ey), scale * (p * ey - q * ex)
    by_end = whitener @ _inverse(_right_jacobian(x, y, angle))
    c, s = math.cos(turned), math.sin(turned)
    # the adjoint of the inverse of the relative pose
    adjoint = np.array(((c, s, s * rx - c * ry), (-s, c, c * rx + s * ry), (0.0, 0.0, 1.0)))
    by_delta = whitener @ _inverse(_right_jacobian(-x, -y, -angle))
    return whitener @ np.array((x, y, angle)), -by_end @ adjoint, by_end, -by_delta @ by_changes


@numba.njit(cache=True)
def _wrapped(angle: float) -> float:
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


@numba.njit(cache=True)
def _arc(angle: float) -> tuple[float, float]:
    if abs(angle) < SMALL:
        return 1.0 - angle * angle / 6.0, angle / 2.0
    return math.sin(angle) / angle, 2.0 * math.sin(angle / 2.0) ** 2 / angle


@numba.njit(cache=True)
def _between(a: Array, b: Array) -> tuple[float, float, float]:
    c, s, dx, dy = math.cos(a[2]), math.sin(a[2]), b[0] - a[0], b[1] - a[1]
    return c * dx + s * dy, c * dy - s * dx, _wrapped(b[2] - a[2])


@numba.njit(cache=True)
def _right_jacobian(x: float, y: float, angle: float) -> Array:
    p, q = _arc(angle)
    if abs(angle) < SMALL:
        r, s = angle / 6.0, 0.5 - angle * angle / 24.0
    else:
        r, s = (1.0 - p) / angle, q / angle
    return np.array(((p, q, r * x - s * y), (-q, p, s * x + r * y), (0.0, 0.0, 1.0)))


@numba.njit(cache=True)
def _inverse(j: Array) -> Array:
    """Of a right Jacobian."""
    p, q, u, v = j[0, 0], j[0, 1], j[0, 2], j[1, 2]
    scale = 1.0 / (p * p + q * q)
    return np.array(
        (
            (scale * p, -scale * q, -scale * (p * u - q * v)),
            (scale * q, scale * p, -scale * (q * u + p * v)),
            (0.0, 0.0, 1.0),
        )
    )
