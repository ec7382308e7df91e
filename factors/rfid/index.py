"""An index of tags by place: which tags are in reach of a pose is asked of a few cells instead of the whole map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.se2 import Array, Integers

CELL = 2.0  # m
Corner = tuple[float, float]
MOST_CELLS = 1 << 20  # a map that is wider has larger cells


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
