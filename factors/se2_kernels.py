"""Compiled :mod:`factors.se2` for single poses, by components."""

import math

import numba
import numpy as np

from factors.se2 import Array

SMALL = 1e-4  # rad; smaller angles use series, against cancellation


@numba.njit(cache=True)
def wrapped(angle: float) -> float:
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


@numba.njit(cache=True)
def arc(angle: float) -> tuple[float, float]:
    """``sin(angle) / angle`` and ``(1 - cos(angle)) / angle``."""
    if abs(angle) < SMALL:
        return 1.0 - angle * angle / 6.0, angle / 2.0
    return math.sin(angle) / angle, 2.0 * math.sin(angle / 2.0) ** 2 / angle


@numba.njit(cache=True)
def exp(x: float, y: float, angle: float) -> tuple[float, float, float]:
    p, q = arc(angle)
    return p * x - q * y, q * x + p * y, wrapped(angle)


@numba.njit(cache=True)
def log(x: float, y: float, heading: float) -> tuple[float, float, float]:
    angle = wrapped(heading)
    p, q = arc(angle)
    scale = 1.0 / (p * p + q * q)
    return scale * (p * x + q * y), scale * (p * y - q * x), angle


@numba.njit(cache=True)
def composed(x: float, y: float, heading: float, dx: float, dy: float, turned: float) -> tuple[float, float, float]:
    """The pose (dx, dy, turned) in the frame of another one."""
    c, s = math.cos(heading), math.sin(heading)
    return x + c * dx - s * dy, y + s * dx + c * dy, wrapped(heading + turned)


@numba.njit(cache=True)
def related(x: float, y: float, heading: float, to_x: float, to_y: float, to: float) -> tuple[float, float, float]:
    """The pose (to_x, to_y, to) as seen from another one."""
    c, s, dx, dy = math.cos(heading), math.sin(heading), to_x - x, to_y - y
    return c * dx + s * dy, c * dy - s * dx, wrapped(to - heading)


@numba.njit(cache=True)
def moved(pose: Array, twist: Array) -> Array:
    """The pose (3,) moved by a twist in its own frame, of which the first three components are read."""
    x, y, turned = exp(twist[0], twist[1], twist[2])
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array((pose[0] + c * x - s * y, pose[1] + s * x + c * y, wrapped(pose[2] + turned)))


@numba.njit(cache=True)
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
