"""Fits detection grids, and selects the kind of detection model that predicts held-out reads best.

A detection grid consists of logits of the read probability on a grid in the antenna frame. The difference of the grid
to a parametric model is fitted. A penalty on second differences makes it smooth (Eilers and Marx, "Flexible smoothing
with B-splines and penalties", Statistical Science 11(2), 1996). Far from all data the difference is zero.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy import sparse
from scipy.optimize import minimize

from factorgraph_loc.fitting.posterior import by_block
from factorgraph_loc.sensors.rfid.calibration.pairs import Floor, TagPairs, modelled, terms
from factorgraph_loc.sensors.rfid.calibration.parametric import beam, fit_model, logistic
from factorgraph_loc.sensors.rfid.calibration.rounds import cells
from factors.rfid import knots
from factors.rfid.model import BeamModel, DetectionModel, GridModel, bake, logits
from factors.se2 import Array

CELL = 0.5  # m; distance between knots
EXTENT = 6.0  # m; half the side of a grid
FACINGS = 5  # number of grid points along the axis for the facing
HEIGHT_STEP = 0.5  # m; distance between grid points in height
PULL = 0.3  # weight of squared differences between the grid and the parametric model
GRADIENT = 0.01  # nats per logit; the fit ends when the gradient is smaller
FINE = (0.2, 0.2, 0.25, 0.2)  # m, m, m, cosine; size of cells for the merging of pairs
SMOOTHNESS = 5.0  # weight of squared second differences of logits
WORTH = 1e-3  # nats per round; minimum gain of a more complex model
MODEL_PAIRS = 40000  # maximum number of pairs for the fit of a parametric model


def fit_grid(pairs: TagPairs, parametric: DetectionModel, smoothness: float, floor: Floor) -> GridModel:
    """Return a detection model on a grid, fitted to the reads and misses of ``pairs``. Far from data it is
    ``parametric``.

    ``smoothness``: the weight of the squared second differences of logits. ``floor``: minimum probabilities of a read
    and of a miss. The grid has an axis for height if the heights of ``pairs`` differ. It has an axis for the tag's
    facing if ``parametric`` depends on it.
    """
    base = bake(parametric, EXTENT, CELL, _heights(pairs), FACINGS if parametric.uses_facing else 1)
    shape = (base.logits.shape[0], 1, *base.logits.shape[2:])
    few = _merged(pairs)
    offset, _ = logits(base, few.points, few.facing)
    change = replace(base, logits=np.zeros(shape))
    penalty = (smoothness * _roughness(shape) + PULL * sparse.eye_array(change.logits.size)).tocsc()
    design = design_of(change, few.points, few.facing)

    def cost(p: Array) -> tuple[float, Array]:
        likelihood = terms(offset + design @ p, few.hits, few.count, floor)
        value = float(np.sum(likelihood.nll) + 0.5 * p @ (penalty @ p))
        return value, design.T @ likelihood.gradient + penalty @ p

    @lru_cache(maxsize=1)
    def curvature(p: bytes) -> sparse.csr_array:
        information = terms(offset + design @ np.frombuffer(p), few.hits, few.count, floor).information
        return design.T @ sparse.diags_array(information) @ design + penalty

    result = minimize(
        cost,
        np.zeros(change.logits.size),
        jac=True,
        hessp=lambda p, v: curvature(p.tobytes()) @ v,
        method="trust-ncg",
        options={"gtol": GRADIENT},
    )
    return replace(base, logits=base.logits + result.x.reshape(shape))


def _heights(pairs: TagPairs) -> list[float]:
    """Return the heights [m] of the layers of a grid: multiples of HEIGHT_STEP that cover nearly all ``pairs``. If all
    pairs have nearly the same height, only this height is returned."""
    low, high = np.quantile(pairs.points[:, 2], (0.01, 0.99)).tolist()
    if high - low < HEIGHT_STEP:
        return [round(0.5 * (low + high), 3)]
    return [round(k * HEIGHT_STEP, 3) for k in range(math.floor(low / HEIGHT_STEP), math.ceil(high / HEIGHT_STEP) + 1)]


def design_of(grid: GridModel, points: Array, facing: Array) -> sparse.csr_array:
    """Return the sparse matrix (M, number of grid points) that interpolates the logits of ``grid`` at M tags.
    ``points`` (M, 3): tag positions in the antenna frame [m]. ``facing`` (M,): cosine of the angle between the
    direction of the tag's front and the direction to the antenna."""
    shape, heights = grid.logits.shape, grid.heights
    axes = [
        knots.linear((points[:, 2] - heights[0]) / (heights[1] - heights[0] if len(heights) > 1 else 1.0), shape[0]),
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


def _roughness(shape: Sequence[int]) -> sparse.csc_array:
    """Return the matrix of a quadratic form of the values on a grid with this ``shape``: the sum of squared second
    differences along all axes. An axis with two grid points has first differences."""
    total = sparse.csc_array((int(np.prod(shape)),) * 2)
    for axis, size in enumerate(shape):
        if size < 2:
            continue
        stencil = (1.0, -2.0, 1.0) if size > 2 else (-1.0, 1.0)
        rows = size - len(stencil) + 1
        difference = sparse.diags_array(stencil, offsets=range(len(stencil)), shape=(rows, size))
        outer, inner = (sparse.eye_array(int(np.prod(part))) for part in (shape[:axis], shape[axis + 1 :]))
        whole = sparse.kron(sparse.kron(outer, difference), inner)
        total = total + whole.T @ whole
    return total.tocsc()


def _merged(pairs: TagPairs) -> TagPairs:
    """Return ``pairs`` with nearly equal positions and facings merged into one pair at their mean."""
    rows = np.column_stack((pairs.points, pairs.facing))
    first, cell = cells(rows, FINE)
    hits, count = by_block(np.column_stack((pairs.hits, pairs.count)), cell).T
    mean = by_block(pairs.count[:, None] * rows, cell) / count[:, None]
    return replace(pairs.part(first), points=mean[:, :3], facing=mean[:, 3], hits=hits, count=count)


@dataclass(frozen=True)
class Kind:
    """A kind of detection model. ``name``: "beam", "logistic" or "grid". ``facing``: True if the model depends on the
    direction of the tag's front. ``own``: True if each antenna has its own model, False if all share one."""

    name: str
    facing: bool = False
    own: bool = False

    def label(self) -> str:
        """Return the name of this kind of model for tables, such as "logistic, with facing, one for all"."""
        facing = ", with facing" if self.facing else ""
        return f"{self.name}{facing}, {'one per antenna' if self.own else 'one for all'}"


def fit(pairs: TagPairs, kind: Kind, floor: Floor, antennas: int) -> tuple[tuple[DetectionModel, ...], tuple[int, ...]]:
    """Return detection models of a ``kind``, fitted to the reads and misses of ``pairs``, and the index of the model of
    each antenna. An antenna without data gets a model that is fitted to all antennas. ``floor``: minimum probabilities
    of a read and of a miss. ``antennas``: the number of antennas."""
    if not kind.own:
        return (_fit_one(pairs, kind, floor),), (0,) * antennas
    active = [a for a in range(antennas) if np.any(pairs.antenna == a)]
    models = [_fit_one(pairs.part(pairs.antenna == a), kind, floor) for a in active]
    if len(active) < antennas:
        models.append(_fit_one(pairs, kind, floor))
    return tuple(models), tuple(active.index(a) if a in active else len(active) for a in range(antennas))


def choose(pairs: TagPairs, floor: Floor, antennas: int, *, facing: bool) -> tuple[Kind, dict[Kind, float]]:
    """Return the best kind of detection model by cross-validation, and the score of each kind.

    The score is the negative log-likelihood [nats per round] of held-out ``pairs``. A more complex model must be better
    than a simpler one by :data:`WORTH`. ``floor``: minimum probabilities of a read and of a miss. ``antennas``: the
    number of antennas. ``facing``: True if the facing of tags is known.
    """
    kinds = [Kind("beam"), Kind("logistic"), *([Kind("logistic", facing=True)] if facing else [])]
    if antennas > 1:
        kinds.append(Kind("logistic", facing, own=True))
    kinds.append(Kind("grid", facing))
    scores = {kind: _held_out(pairs, kind, floor, antennas) for kind in kinds}
    best = kinds[0]
    for kind, score in scores.items():
        best = kind if score < scores[best] - WORTH else best
    return best, scores


def _fit_one(pairs: TagPairs, kind: Kind, floor: Floor) -> DetectionModel:
    """Return one detection model of a ``kind``, fitted to all ``pairs``. ``floor``: minimum probabilities of a read and
    a miss."""
    some = pairs.part(np.arange(len(pairs.facing)) % (1 + len(pairs.facing) // MODEL_PAIRS) == 0)
    if kind.name == "beam":
        return fit_model(some, beam(BeamModel()), floor)[0]
    parametric = fit_model(some, logistic(some, with_facing=kind.facing), floor)[0]
    return parametric if kind.name == "logistic" else fit_grid(pairs, parametric, SMOOTHNESS, floor)


def _held_out(pairs: TagPairs, kind: Kind, floor: Floor, antennas: int) -> float:
    """Return the cross-validated negative log-likelihood [nats per round] of a ``kind`` of model. Each fold of
    ``pairs`` is predicted by models that are fitted to the other folds. ``floor``: see :func:`fit`. ``antennas``: the
    number of antennas."""
    total = 0.0
    for fold in np.unique(pairs.fold):
        models, which = fit(pairs.part(pairs.fold != fold), kind, floor, antennas)
        test = pairs.part(pairs.fold == fold)
        total += float(np.sum(terms(modelled(models, which, test), test.hits, test.count, floor).nll))
    return total / float(np.sum(pairs.count))
