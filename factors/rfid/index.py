"""Tags of a map by position, and read counts of tags: which tags count for a pose, in compiled code.

An index finds the tags in reach of a pose in a few cells instead of the whole map.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.se2 import Array, Integers, exp_scalars, wrap_scalar

CELL = 2.0  # m
SPARE = 0.5  # m: tags are found in a box on a grid of this size, which neighbouring poses share
Corner = tuple[float, float]
MOST_CELLS = 1 << 20  # a map that is wider has larger cells
# offsets, antennas, rounds, hits, odds and elsewhere; the places in the map that are listed, the odds of the others, and the twists
Counts = tuple[Array, Integers, Integers, Integers, Array, Array, Integers, float, Array]


class TagIndex(NamedTuple):
    """T tags by cells of ``cell`` [m] in rows of ``columns``, the first at ``corner`` (2,): ``order`` (T,), their places in the
    map, cell by cell, those of a cell ascending; ``start`` (C + 1,): where each cell begins there."""

    corner: Array
    cell: float
    columns: int
    start: Integers
    order: Integers


def tag_index(points: Array) -> TagIndex:
    """The index of tags at ``points`` (T, 3) [m]."""
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
    """First and last of ``count`` cells along an axis that an interval touches; the last is before the first if none is."""
    first = (low - index.corner[axis]) / index.cell
    last = (high - index.corner[axis]) / index.cell
    if not (first < count and last >= 0.0):
        return 0, -1
    return int(max(first, 0.0)), int(min(last, count - 1.0))


@compiled
def within(index: TagIndex, low: Array | Corner, high: Array | Corner) -> NDArray[np.int64]:
    """Places, ascending, of the tags in the cells that a box from ``low`` to ``high`` (2,) [m] touches."""
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
    """The tags of a map: ``points`` (T, 3) [m] and ``normals`` (T, 2), with their index."""

    cells: TagIndex
    points: Array
    normals: Array


class NearTags(NamedTuple):
    """C tags that matter to some poses: places in the map, ascending, with survey, reads and states."""

    tags: Integers
    points: Array
    normals: Array
    hits: Integers
    odds: Array
    elsewhere: Array


@compiled
def _box(poses: Array, reach: float) -> tuple[Corner, Corner]:
    """The corners of the box that holds what is within ``reach`` [m] of poses (N, 3), on a grid, so that the same tags count
    whatever was looked at before: to the last bit, sums depend on them."""
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for n in range(len(poses)):
        low_x, high_x = min(low_x, poses[n, 0]), max(high_x, poses[n, 0])
        low_y, high_y = min(low_y, poses[n, 1]), max(high_y, poses[n, 1])
    low = SPARE * math.floor((low_x - reach) / SPARE), SPARE * math.floor((low_y - reach) / SPARE)
    return low, (SPARE * math.ceil((high_x + reach) / SPARE), SPARE * math.ceil((high_y + reach) / SPARE))


@compiled
def near_tags(of_map: MapTags, counts: Counts, poses: Array, reach: float) -> NearTags:
    """The tags within ``reach`` [m] of poses (N, 3), or in the same cells, and those that are listed in what was ``counts``
    (:attr:`factors.rfid.detection.TagReadCounts.packed`)."""
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
    """The poses (K, 3) ``offset`` (3,) composed with ``offsets`` (K, 3)."""
    c, s, out = math.cos(offset[2]), math.sin(offset[2]), np.empty_like(offsets)
    for k in range(len(offsets)):
        out[k, 0] = offset[0] + c * offsets[k, 0] - s * offsets[k, 1]
        out[k, 1] = offset[1] + s * offsets[k, 0] + c * offsets[k, 1]
        out[k, 2] = wrap_scalar(offset[2] + offsets[k, 2])
    return out


@compiled
def delayed(poses: Array, twists: Array, delays: Array) -> Array:
    """The poses (K, 3) ``delays`` [s] (K or 1,) later, of a robot with velocities ``twists`` (K or 1, 3)."""
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
    """All numbers of either, which are ascending both."""
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
    """Hits, odds and elsewhere of ``tags``, both ascending; tags that are not listed have 0 hits, ``unlisted_odds`` and 0."""
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
