"""The detection field in an antenna's frame, as a grid of logits fitted to pairs.

The grid is fitted as a difference to a parametric field: smooth by a penalty on second differences (Eilers and Marx, "Flexible
smoothing with B-splines and penalties", Statistical Science 11(2), 1996), and zero where there are no data. Logits are interpolated
as in :mod:`factors.rfid.model`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from factorgraph_loc.sensors.rfid.calibration.fit import Floor, fit_linear
from factorgraph_loc.sensors.rfid.calibration.pairs import TagPairs
from factors.rfid import knots
from factors.rfid.model import DetectionModel, GridModel, bake, logits
from factors.se2 import Array

CELL = 0.5  # m
EXTENT = 6.0  # m
FACINGS = 5  # knots, if the facing is used
HEIGHT_STEP = 0.5  # m
PULL = 0.3  # penalty of a knot's difference to the parametric field, in nats
FINE = (0.2, 0.2, 0.25, 0.2)  # m, m, m and cosine; closer pairs are merged


@dataclass(frozen=True)
class Axes:
    """Axes along which a field differs from the parametric one: x and y, also height, or also facing."""

    by_height: bool = False
    by_facing: bool = False


def fit_grid(pairs: TagPairs, parametric: DetectionModel, smoothness: float, axes: Axes, floor: Floor) -> GridModel:
    """Fit a grid to pairs, near to the ``parametric`` model; ``smoothness``: weight of squared second differences of logits.

    The grid has a height axis if the heights of ``pairs`` differ, and a facing axis if the model has one. Along axes that ``axes``
    excludes, the difference to the parametric model is constant.
    """
    heights = _heights(pairs)
    base = bake(parametric, EXTENT, CELL, heights, FACINGS if parametric.uses_facing or axes.by_facing else 1)
    shape = base.logits.shape
    varied = (shape[0] if axes.by_height else 1, shape[1] if axes.by_facing else 1, *shape[2:])
    few = _together(pairs)
    offset, _ = logits(base, few.points, few.facing)
    change = replace(base, logits=np.zeros(varied), heights=base.heights if axes.by_height else np.zeros(1))
    penalty = (smoothness * _roughness(varied) + PULL * sparse.eye_array(change.logits.size)).tocsc()
    found = fit_linear(design_of(change, few.points, few.facing), offset, few.hits, few.count, penalty, floor)
    return replace(base, logits=base.logits + found.reshape(varied))


def _heights(pairs: TagPairs) -> list[float]:
    """Evenly spaced heights over nearly all pairs, including zero if it is within; a single one if all are equal."""
    low, high = np.quantile(pairs.points[:, 2], (0.01, 0.99)).tolist()
    if high - low < HEIGHT_STEP:
        return [round(0.5 * (low + high), 3)]
    return [round(k * HEIGHT_STEP, 3) for k in range(math.floor(low / HEIGHT_STEP), math.ceil(high / HEIGHT_STEP) + 1)]


def design_of(grid: GridModel, points: Array, facing: Array) -> sparse.csr_array:
    """The matrix (M, knots) from the grid's knots to logits at ``points`` (M, 3) with ``facing`` (M,)."""
    shape = grid.logits.shape
    axes = [
        knots.linear((points[:, 2] - grid.heights[0]) / _step(grid.heights), shape[0]),
        knots.cubic(0.5 * (facing + 1.0) * (shape[1] - 1), shape[1]),
        knots.cubic((points[:, 0] - grid.x0) / grid.cell, shape[2]),
        knots.cubic((points[:, 1] - grid.y0) / grid.cell, shape[3]),
    ]
    columns, weights = np.zeros((len(points), 1), dtype=np.int64), np.ones((len(points), 1))
    for size, (places, shares) in zip(shape, axes, strict=True):
        columns = (columns[:, :, None] * size + places[:, None, :]).reshape(len(points), -1)
        weights = (weights[:, :, None] * shares[:, None, :]).reshape(len(points), -1)
    ends = columns.shape[1] * np.arange(len(points) + 1)
    return sparse.csr_array((weights.ravel(), columns.ravel(), ends), shape=(len(points), grid.logits.size))


def _step(heights: Array) -> float:
    return float(heights[1] - heights[0]) if len(heights) > 1 else 1.0


def _roughness(shape: Sequence[int]) -> sparse.csc_array:
    """The sum of squared second differences along each axis, or first differences if an axis has two knots."""
    total = sparse.csc_array((int(np.prod(shape)),) * 2)
    for axis, size in enumerate(shape):
        if size < 2:
            continue
        stencil = (1.0, -2.0, 1.0) if size > 2 else (-1.0, 1.0)
        rows = size - len(stencil) + 1
        difference = sparse.diags_array(stencil, offsets=range(len(stencil)), shape=(rows, size))
        before, after = int(np.prod(shape[:axis])), int(np.prod(shape[axis + 1 :]))
        whole = sparse.kron(sparse.kron(sparse.eye_array(before), difference), sparse.eye_array(after))
        total = total + whole.T @ whole
    return total.tocsc()


def _together(pairs: TagPairs) -> TagPairs:
    """Merge pairs at nearly equal positions at their mean."""
    keys = np.floor(np.column_stack((pairs.points, pairs.facing)) / FINE).astype(np.int64)
    keys -= keys.min(axis=0)
    _, first, inverse = np.unique(
        np.ravel_multi_index(tuple(keys.T), tuple(keys.max(axis=0) + 1)), return_index=True, return_inverse=True
    )

    def total(values: Array) -> Array:
        return np.asarray(np.bincount(inverse, weights=values, minlength=len(first)), dtype=float)

    count = total(pairs.count)
    return replace(
        pairs.part(first),
        points=np.column_stack([total(pairs.count * column) / count for column in pairs.points.T]),
        facing=total(pairs.count * pairs.facing) / count,
        hits=total(pairs.hits),
        count=count,
    )
