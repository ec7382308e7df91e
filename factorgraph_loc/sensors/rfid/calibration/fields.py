"""Detection fields, and the selection of the detection model that predicts held-out reads best.

A field is a grid of logits in an antenna's frame, fitted as a difference to a parametric model: smooth by a penalty on second
differences (Eilers and Marx, "Flexible smoothing with B-splines and penalties", Statistical Science 11(2), 1996), and zero where
there are no data. Logits are interpolated as in :mod:`factors.rfid.model`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy import sparse
from scipy.optimize import minimize

from factorgraph_loc.sensors.rfid.calibration.pairs import Floor, TagPairs, modelled, terms
from factorgraph_loc.sensors.rfid.calibration.parametric import beam, fit_model, logistic
from factors.rfid import knots
from factors.rfid.model import BeamModel, DetectionModel, GridModel, bake, logits
from factors.se2 import Array

CELL = 0.5  # m
EXTENT = 6.0  # m
FACINGS = 5  # knots, if the facing is used
HEIGHT_STEP = 0.5  # m
PULL = 0.3  # penalty of a knot's difference to the parametric field, in nats
GRADIENT = 0.01  # nats per logit, at which a field is found
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
    design = design_of(change, few.points, few.facing)

    def cost(p: Array) -> tuple[float, Array]:
        found = terms(offset + design @ p, few.hits, few.count, floor)
        return float(np.sum(found.nll) + 0.5 * p @ (penalty @ p)), design.T @ found.gradient + penalty @ p

    @lru_cache(maxsize=1)
    def curvature(p: bytes) -> sparse.csr_array:
        information = terms(offset + design @ np.frombuffer(p), few.hits, few.count, floor).information
        return design.T @ sparse.diags_array(information) @ design + penalty

    start = np.zeros(change.logits.size)
    found = minimize(
        cost,
        start,
        jac=True,
        hessp=lambda p, v: curvature(p.tobytes()) @ v,
        method="trust-ncg",
        options={"gtol": GRADIENT},
    )
    return replace(base, logits=base.logits + found.x.reshape(varied))


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


SMOOTHNESS = (5.0, 25.0, 125.0)
WORTH = 1e-3  # nats per pair; minimum gain of a more complex model
MODEL_PAIRS = 40000  # enough for a parametric model


PLANE = Axes()


@dataclass(frozen=True)
class Kind:
    """A model to fit: ``name`` beam, logistic or grid; ``facing``: whether features use the tags' facing; ``own``: one model per
    antenna. ``axes`` and ``smoothness`` of a grid."""

    name: str
    facing: bool = False
    own: bool = False
    axes: Axes = PLANE
    smoothness: float = 0.0

    def label(self) -> str:
        """For tables."""
        words = [self.name]
        if self.name == "logistic":
            words.append("with facing" if self.facing else "without facing")
        if self.axes.by_height:
            words.append("by height")
        if self.axes.by_facing:
            words.append("by facing")
        return ", ".join([*words, "one an antenna" if self.own else "one for all"])


@dataclass(frozen=True)
class CrossValidation:
    """Held-out negative log-likelihood [nats per pair] of a model, per fold and over all."""

    kind: Kind
    by_fold: tuple[float, ...]
    nll: float


def fit(pairs: TagPairs, kind: Kind, floor: Floor, antennas: int) -> tuple[tuple[DetectionModel, ...], tuple[int, ...]]:
    """The models, and the model index of each antenna. An antenna without rounds has the common model."""
    if not kind.own:
        return (_fit_one(pairs, kind, floor),), (0,) * antennas
    heard = [a for a in range(antennas) if np.any(pairs.antenna == a)]
    models = [_fit_one(pairs.part(pairs.antenna == a), kind, floor) for a in heard]
    if len(heard) < antennas:
        models.append(_fit_one(pairs, kind, floor))
    return tuple(models), tuple(heard.index(a) if a in heard else len(heard) for a in range(antennas))


def choose(pairs: TagPairs, floor: Floor, antennas: int, *, facing: bool) -> tuple[Kind, tuple[CrossValidation, ...]]:
    """The kind of model that is best by its likelihood on held-out folds of ``pairs``, and all trials.

    A more complex model must gain :data:`WORTH` over a simpler one. ``facing``: whether the tags' facing is known.
    """
    trials: list[CrossValidation] = []

    def tried(kind: Kind) -> CrossValidation:
        trials.append(_trial(pairs, kind, floor, antennas))
        return trials[-1]

    def better(best: CrossValidation, kind: Kind) -> CrossValidation:
        trial = tried(kind)
        return trial if trial.nll < best.nll - WORTH else best

    best = tried(Kind("beam"))
    best = better(best, Kind("logistic"))
    if facing:
        best = better(best, Kind("logistic", facing=True))
    uses_facing = best.kind.facing
    if antennas > 1:
        best = better(best, Kind("logistic", facing=uses_facing, own=True))
    fields = [tried(Kind("grid", uses_facing, smoothness=s)) for s in SMOOTHNESS]
    field = min(fields, key=lambda t: t.nll)
    smoothness = field.kind.smoothness
    if uses_facing:
        field = better(field, Kind("grid", True, axes=Axes(by_facing=True), smoothness=smoothness))
    if np.ptp(np.quantile(pairs.points[:, 2], (0.02, 0.98))) > 0.5:
        field = better(field, Kind("grid", uses_facing, axes=Axes(by_height=True), smoothness=smoothness))
    if field.nll < best.nll - WORTH:
        best = field
    return best.kind, tuple(trials)


def held_out(pairs: TagPairs, kind: Kind, floor: Floor, antennas: int) -> Array:
    """Probability (M,) of a read, floor included, for each fold from a fit to the others."""
    out = np.empty(len(pairs.facing))
    for fold in np.unique(pairs.fold):
        test = pairs.fold == fold
        models, which = fit(pairs.part(~test), kind, floor, antennas)
        out[test] = floor.probability(modelled(models, which, pairs.part(test)))
    return out


def _fit_one(pairs: TagPairs, kind: Kind, floor: Floor) -> DetectionModel:
    some = pairs.part(np.arange(len(pairs.facing)) % (1 + len(pairs.facing) // MODEL_PAIRS) == 0)
    if kind.name == "beam":
        return fit_model(some, beam(BeamModel()), floor)[0]
    parametric = fit_model(some, logistic(some, with_facing=kind.facing), floor)[0]
    return parametric if kind.name == "logistic" else fit_grid(pairs, parametric, kind.smoothness, kind.axes, floor)


def _trial(pairs: TagPairs, kind: Kind, floor: Floor, antennas: int) -> CrossValidation:
    q = held_out(pairs, kind, floor, antennas)
    nll = -(pairs.hits * np.log(q) + (pairs.count - pairs.hits) * np.log1p(-q))
    folds = [pairs.fold == fold for fold in np.unique(pairs.fold)]
    each = tuple(float(np.sum(nll[one]) / np.sum(pairs.count[one])) for one in folds)
    return CrossValidation(kind, each, float(np.sum(nll) / np.sum(pairs.count)))
