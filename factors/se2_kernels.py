"""Compiled :mod:`factors.se2` for single poses, by components."""

import math

import numba

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
