"""Selection of pixels that are spread over an image, as neighbours are redundant."""

import math
from collections.abc import Sequence

import numpy as np

from factorgraph_loc.vision.keypoints import Integers
from factors.se2 import Array

PARTS = 12  # of an image that has features everywhere: with more the weakest would be among them


def spread_out(pixels: Array, count: int, priority: Sequence[int] | None = None, cells: int | None = None) -> Integers:
    """Indices of at most ``count`` of ``pixels`` (K, 2), ascending, taken in turn from about as many ``cells`` of a grid, ``count``
    by default; in each cell by ``priority`` (K,), highest first, else in their order."""
    if len(pixels) <= count:
        return np.arange(len(pixels))
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    side = max(math.sqrt(float(np.prod(high - low)) / (cells or count)), 1.0)
    column, line = np.floor((pixels - low) / side).T
    cell = column * (line.max() + 1.0) + line
    order = np.lexsort((np.zeros(len(pixels)) if priority is None else -np.asarray(priority), cell))
    turns = np.empty(len(pixels), dtype=np.int64)
    turns[order] = np.arange(len(pixels)) - np.searchsorted(cell[order], cell[order])  # rank within the cell
    return np.sort(np.argsort(turns, kind="stable")[:count])
