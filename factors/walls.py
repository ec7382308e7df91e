"""Walls that attenuate radio waves: straight segments in the plane, each with an attenuation [dB].

The attenuations of all walls between an antenna and a tag add up (multi-wall model; Keenan and Motley, "Radio coverage in
buildings", British Telecom Technology Journal 8(1), 1990). How far a passive tag is read depends on the power that reaches it
(Dobkin, "The RF in RFID", 2008, section 3.6), which falls with the square of the distance (Friis, "A note on a simple transmission
formula", Proc. IRE 34(5), 1946). So behind walls of L dB a tag is read as often as one that is ``10^(L / 20)`` times as far away in
the same direction, whatever the detection model is.

The factor is constant except where a wall's end comes between the two. There it jumps, which derivatives leave out.
"""

import math
from typing import NamedTuple

import numpy as np

from factors.compiled import compiled
from factors.se2 import Array, Integers, transform_from

CELL = 1.0  # m
MOST_CELLS = 1 << 14  # walls that are spread over more have larger cells


class Walls(NamedTuple):
    """``lines`` (W, 4): one end of each wall and the vector to the other [m]; ``factor`` (W,): of the distance, above 1.

    By cells of ``cell`` [m] in rows of ``columns``, the first at ``corner`` (2,), ``order`` (K,): the walls that may be between a
    place in a cell and another in reach of it; ``start`` (C + 1,): where each cell begins there."""

    lines: Array
    factor: Array
    corner: Array
    cell: float
    columns: int
    start: Integers
    order: Integers


def walls_around(segments: Array, reach: float) -> Walls | None:
    """Walls x1, y1, x2, y2 [m] and attenuation [dB], (W, 5), for places that are at most ``reach`` [m] apart; None if none
    attenuates, for which compiled code has no branch."""
    segments = segments[segments[:, 4] > 0.0]
    if not len(segments):
        return None
    ends = segments[:, :4].reshape(-1, 2)
    low, high = ends.min(axis=0), ends.max(axis=0)
    size = high - low + 2.0 * reach
    cell = max(CELL, math.sqrt(float(np.prod(size)) / MOST_CELLS), float(size.max()) / MOST_CELLS)
    columns, rows = np.ceil(size / cell).astype(np.int64).tolist()
    x, y = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    centres = low - reach + cell * np.column_stack((x.ravel(), y.ravel()))
    near = [np.flatnonzero(_distance(centres, wall) <= reach + cell * math.sqrt(0.5)) for wall in segments]
    cells = np.concatenate(near)
    order = np.repeat(np.arange(len(segments)), [len(one) for one in near])[np.argsort(cells, kind="stable")]
    return Walls(
        np.column_stack((segments[:, :2], segments[:, 2:4] - segments[:, :2])),
        np.power(10.0, segments[:, 4] / 20.0),
        low - reach,
        cell,
        columns,
        np.concatenate(([0], np.cumsum(np.bincount(cells, minlength=columns * rows)))).astype(np.int64),
        order.astype(np.int64),
    )


def moved(segments: Array, transform: Array) -> Array:
    """The walls (W, 5) in another frame, in which the pose (3,) of theirs is ``transform``."""
    ends = transform_from(transform, segments[:, :4].reshape(-1, 2)).reshape(-1, 4)
    return np.column_stack((ends, segments[:, 4]))


def _distance(points: Array, wall: Array) -> Array:
    """Distances (N,) [m] of points (N, 2) from one wall."""
    along = wall[2:4] - wall[:2]
    share = np.clip((points - wall[:2]) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    return np.asarray(np.hypot(*(points - wall[:2] - share[:, None] * along).T))


NO_WALLS = np.empty((0, 5))


@compiled(inline="always")
def crosses(line: Array, ax: float, ay: float, bx: float, by: float) -> bool:
    """Whether a wall (4,) is between two places. One on the wall itself has it on no side."""
    x, y, dx, dy = line[0], line[1], line[2], line[3]
    side_a, side_b = dx * (ay - y) - dy * (ax - x), dx * (by - y) - dy * (bx - x)
    ex, ey = bx - ax, by - ay
    first = ex * (y - ay) - ey * (x - ax)
    return bool((side_a * side_b < 0.0) & (first * (first + ex * dy - ey * dx) <= 0.0))


@compiled
def around(walls: Walls, x: float, y: float) -> tuple[int, int]:
    """The first of the walls in ``order`` that matter at a place, and the end of them."""
    i, j = (x - walls.corner[0]) / walls.cell, (y - walls.corner[1]) / walls.cell
    rows = (len(walls.start) - 1) // walls.columns
    if not (0.0 <= i < walls.columns and 0.0 <= j < rows):
        return 0, 0
    cell = int(j) * walls.columns + int(i)
    return walls.start[cell], walls.start[cell + 1]


@compiled
def farther(walls: Walls | None, ax: float, ay: float, bx: float, by: float) -> float:
    """The factor by which the walls between two places make the second one seem farther away."""
    if walls is None:
        return 1.0
    out = 1.0
    first, end = around(walls, bx, by)
    for k in range(first, end):
        w = walls.order[k]
        if crosses(walls.lines[w], ax, ay, bx, by):
            out *= walls.factor[w]
    return out


@compiled
def all_farther(walls: Walls | None, antennas: Array, tags: Array) -> Array:
    """The factors (N, T) of :func:`farther` from ``antennas`` (N, 2) to ``tags`` (T, 2)."""
    out = np.ones((len(antennas), len(tags)))
    if walls is None:
        return out
    for n in range(len(antennas)):
        for t in range(len(tags)):
            out[n, t] = farther(walls, antennas[n, 0], antennas[n, 1], tags[t, 0], tags[t, 1])
    return out
