"""Walls, and lines of sight."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array


class Walled(Protocol):
    """Anything with walls, such as a world: its ``name``, and segments (x1, y1, x2, y2) [m]."""

    @property
    def name(self) -> str: ...

    @property
    def walls(self) -> Sequence[tuple[float, float, float, float]]: ...


def crosses(world: Walled, a: Array, b: Array) -> NDArray[np.bool_]:
    """Whether the segments from ``a`` (N, 2) to ``b`` (N, 2) cross a wall of the world."""
    out = np.zeros(len(a), dtype=bool)
    d = b - a
    for x1, y1, x2, y2 in world.walls:
        wall = np.array((x2 - x1, y2 - y1))
        start = np.array((x1, y1))
        side_a, side_b = _cross(wall, a - start), _cross(wall, b - start)
        side_1, side_2 = _cross(d, start - a), _cross(d, start + wall - a)
        out |= (side_a * side_b < 0.0) & (side_1 * side_2 <= 0.0)
    return out


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
