"""Selection of the tags that matter for a pose, in compiled code.

A spatial index of square cells finds the tags in reach of a pose without a loop over the whole map.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.se2 import Array, Integers, exp_scalars, wrap_scalar

CELL = 2.0  # m; size of a cell of the index
SPARE = 0.5  # m; the corners of search boxes are rounded outwards to multiples of this
Corner = tuple[float, float]
MOST_CELLS = 1 << 20  # maximum number of cells; a larger map has larger cells
# The fields of factors.rfid.detection.TagReadCounts for compiled code: offsets, antennas, rounds, hits, odds, elsewhere, tags,
# unlisted_odds, twists.
Counts = tuple[Array, Integers, Integers, Integers, Array, Array, Integers, float, Array]


class TagIndex(NamedTuple):
    """A spatial index of T tags in square cells.

    ``corner`` (2,) [m]: the lower corner of the first cell. ``cell`` [m]: the size of a cell. ``columns``: the number
    of cells in a row. The C cells are numbered row by row.
    ``order`` (T,): the indices of the tags in the map, cell by cell, and ascending within a cell.
    ``start`` (C + 1,): the index in ``order`` of the first tag of each cell.
    """

    corner: Array
    cell: float
    columns: int
    start: Integers
    order: Integers


def tag_index(points: Array) -> TagIndex:
    """Return the spatial index of tags at ``points`` (T, 3) [m]."""
    if not len(points):
        return TagIndex(np.zeros(2), CELL, 1, np.zeros(2, dtype=np.int64), np.empty(0, dtype=np.int64))
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    cell = max(CELL, float(np.sqrt(np.prod(high - low + CELL) / MOST_CELLS)), float(np.max(high - low)) / MOST_CELLS)
    columns, rows = (np.floor((high - low) / cell).astype(np.int64) + 1).tolist()
    at = np.floor((points[:, :2] - low) / cell).astype(np.int64)
    number = at[:, 1] * columns + at[:, 0]
    counts = np.bincount(number, minlength=columns * rows)
    start = np.concatenate((np.zeros(1, dtype=np.int64), np.cumsum(counts)))
    return TagIndex(low, cell, columns, start, np.argsort(number, kind="stable"))


@compiled(inline="always")
def cells(index: TagIndex, low: float, high: float, axis: int, count: int) -> tuple[int, int]:
    """Return the indices of the first and last cell along an axis (0 for x, 1 for y) that the interval from ``low`` to
    ``high`` [m] touches. ``count``: number of cells along the axis. Returns (0, -1) if the interval touches none."""
    first = (low - index.corner[axis]) / index.cell
    last = (high - index.corner[axis]) / index.cell
    if not (first < count and last >= 0.0):
        return 0, -1
    return int(max(first, 0.0)), int(min(last, count - 1.0))


@compiled
def within(index: TagIndex, low: Array | Corner, high: Array | Corner) -> NDArray[np.int64]:
    """Return the map indices of all tags whose cells touch the box from ``low`` to ``high`` (2,) [m], ascending."""
    rows = (len(index.start) - 1) // index.columns
    first_x, last_x = cells(index, low[0], high[0], 0, index.columns)
    first_y, last_y = cells(index, low[1], high[1], 1, rows)
    count = 0
    for y in range(first_y, last_y + 1):
        if last_x >= first_x:
            count += index.start[y * index.columns + last_x + 1] - index.start[y * index.columns + first_x]
    out = np.empty(count, np.int64)
    count = 0
    for y in range(first_y, last_y + 1):
        if last_x >= first_x:
            for k in range(index.start[y * index.columns + first_x], index.start[y * index.columns + last_x + 1]):
                out[count] = index.order[k]
                count += 1
    out.sort()
    return out


class MapTags(NamedTuple):
    """The tags of a map: ``points`` (T, 3) [m], ``normals`` (T, 2) (unit vectors of the tags' fronts, zero if unknown),
    and ``cells``, the spatial index."""

    cells: TagIndex
    points: Array
    normals: Array


class NearTags(NamedTuple):
    """The C tags that are near some poses or listed in the reads. ``tags`` (C,): indices in the map, ascending.
    ``points`` (C, 3), ``normals`` (C, 2): positions and unit vectors of the fronts. ``hits`` (K, C): numbers of reads.
    ``odds`` (C,): the prior log-odds that a tag is weak, moved or dead. ``elsewhere`` (C,): the log-likelihood of its
    reads if it is."""

    tags: Integers
    points: Array
    normals: Array
    hits: Integers
    odds: Array
    elsewhere: Array


@compiled
def _box(poses: Array, reach: float) -> tuple[Corner, Corner]:
    """Return the lower and upper corner of a box that contains all points within ``reach`` [m] of poses (N, 3), rounded
    outwards to a grid. Slightly different poses then select the same tags, so that results are reproducible."""
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for n in range(len(poses)):
        low_x, high_x = min(low_x, poses[n, 0]), max(high_x, poses[n, 0])
        low_y, high_y = min(low_y, poses[n, 1]), max(high_y, poses[n, 1])
    low = SPARE * math.floor((low_x - reach) / SPARE), SPARE * math.floor((low_y - reach) / SPARE)
    return low, (SPARE * math.ceil((high_x + reach) / SPARE), SPARE * math.ceil((high_y + reach) / SPARE))


@compiled
def near_tags(of_map: MapTags, counts: Counts, poses: Array, reach: float) -> NearTags:
    """Return the tags of a map that may change the likelihood of poses (N, 3), ascending. These are the tags listed in
    ``counts`` (:attr:`factors.rfid.detection.TagReadCounts.packed`) and at least all within ``reach`` [m] of a pose."""
    _, _, _, hits, odds, elsewhere, listed, unlisted_odds, _ = counts
    low, high = _box(poses, reach)
    tags = union(within(of_map.cells, low, high), listed)
    hits, odds, elsewhere = listing(listed, hits, odds, elsewhere, unlisted_odds, tags)
    points, normals = np.empty((len(tags), 3)), np.empty((len(tags), 2))
    for u in range(len(tags)):
        for i in range(3):
            points[u, i] = of_map.points[tags[u], i]
        for i in range(2):
            normals[u, i] = of_map.normals[tags[u], i]
    return NearTags(tags, points, normals, hits, odds, elsewhere)


@compiled
def moved(offset: Array, offsets: Array) -> Array:
    """Return the poses (K, 3) that result from composing the pose ``offset`` (3,) with each of ``offsets`` (K, 3)."""
    c, s, out = math.cos(offset[2]), math.sin(offset[2]), np.empty_like(offsets)
    for k in range(len(offsets)):
        out[k, 0] = offset[0] + c * offsets[k, 0] - s * offsets[k, 1]
        out[k, 1] = offset[1] + s * offsets[k, 0] + c * offsets[k, 1]
        out[k, 2] = wrap_scalar(offset[2] + offsets[k, 2])
    return out


@compiled
def delayed(poses: Array, twists: Array, delays: Array) -> Array:
    """Return the poses (K, 3) ``delays`` (K or 1,) [s] after ``poses``, for body velocities ``twists`` (K or 1, 3)."""
    if not delays.any():
        return poses
    out = np.empty_like(poses)
    for k in range(len(poses)):
        twist, delay = twists[min(k, len(twists) - 1)], delays[min(k, len(delays) - 1)]
        x, y, turn = exp_scalars(delay * twist[0], delay * twist[1], delay * twist[2])
        c, s = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        out[k, 0], out[k, 1] = poses[k, 0] + c * x - s * y, poses[k, 1] + s * x + c * y
        out[k, 2] = wrap_scalar(poses[k, 2] + turn)
    return out


@compiled
def union(first: Integers, second: Integers) -> Integers:
    """Return the union of the ascending arrays ``first`` and ``second``, ascending and without duplicates."""
    out = np.empty(len(first) + len(second), np.int64)
    i = j = count = 0
    while i < len(first) or j < len(second):
        if j == len(second) or (i < len(first) and first[i] <= second[j]):
            out[count] = first[i]
            j += j < len(second) and first[i] == second[j]
            i += 1
        else:
            out[count] = second[j]
            j += 1
        count += 1
    return out[:count]


@compiled
def listing(
    listed: Integers, hits: Integers, odds: Array, elsewhere: Array, unlisted_odds: float, tags: Integers
) -> tuple[Integers, Array, Array]:
    """Return ``hits`` (K, U), ``odds`` (U,) and ``elsewhere`` (U,) of ``tags`` (U,), see :class:`NearTags`. The
    arguments ``hits`` (K, C), ``odds`` (C,), ``elsewhere`` (C,) are those of the ``listed`` tags (C,). Both arrays of
    tags are ascending. A tag that is not listed has 0 hits, ``unlisted_odds``, and 0 for elsewhere."""
    new_hits = np.zeros((len(hits), len(tags)), np.int64)
    new_odds, new_elsewhere = np.full(len(tags), unlisted_odds), np.zeros(len(tags))
    i = 0
    for u in range(len(tags)):
        while i < len(listed) and listed[i] < tags[u]:
            i += 1
        if i < len(listed) and listed[i] == tags[u]:
            for k in range(len(hits)):
                new_hits[k, u] = hits[k, i]
            new_odds[u], new_elsewhere[u] = odds[i], elsewhere[i]
    return new_hits, new_odds, new_elsewhere
