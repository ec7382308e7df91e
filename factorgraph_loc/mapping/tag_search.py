"""Search for the position of a tag, given known robot poses: all modes of the likelihood, not only the best one.

The likelihood of all antenna observations is evaluated on a lattice, and its best positions are refined by Fisher scoring.
After a straight pass a tag on the left of the robot may be as likely as one on the right. Then there are two modes, with weights
from Laplace's method under a uniform prior.

An unknown facing that matters to the model is tried in :data:`DIRECTIONS`, then between the best of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factors.least_squares import minima
from factors.positive import worst_sigma
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts
from factors.rfid.model import RfidModel, probability
from factors.se2 import Array, Integers, wrap, wrap_scalar

CELL = 0.4  # m, of the lattice
LEVEL = 0.2  # m: tags of about the same height share a lattice
DIRECTIONS = 8
CANDIDATES = 6  # per tag, that are refined
CUT = 40.0  # nats above the minimum on the lattice, beyond which a position is not refined
APART = 0.9  # m or (for facings) rad, between candidates
SAME = 0.05  # m between optima that are considered equal
MERGED = 0.5  # m, or
OVERLAP = 9.0  # squared Mahalanobis distance, between modes that are counted as one
COARSE, FINE = (0.2, 0.15), (0.05, 0.03)  # m and rad within which counts are merged, on the lattice and after
GAIN = 8.0  # of the log-likelihood; false reads can reach less at the best of a few thousand positions
SURE = 0.95  # weight above which a mode is unique
LARGEST_SIGMA = 1.0  # m
LEAST = 0.05  # probability of a read that defines the reach of an antenna
ITERATIONS = 30
CONVERGED = 1e-3  # m
LARGEST_STEP = 0.5  # m
CURVATURE_STEP = 0.02  # m, of the numerical curvature
CHUNK = 256  # candidates per refinement, to bound the memory
PER_EVALUATION = 2000  # observations per evaluation of the lattice, to bound the memory


@dataclass(frozen=True, eq=False)
class TagCandidates:
    """C candidate positions (C, 2) of the tags ``tag`` (C,), with facings (C,)."""

    tag: Integers
    places: Array
    facing: Array

    def __getitem__(self, which: Integers | NDArray[np.bool_]) -> TagCandidates:
        return TagCandidates(self.tag[which], self.places[which], self.facing[which])


@dataclass(frozen=True)
class TagMode:
    """A mode of a tag's position: ``position`` (2,) [m], ``covariance`` (2, 2), ``facing`` [rad] or NaN, and its weight."""

    weight: float
    position: Array
    covariance: Array
    facing: float

    @property
    def sigma(self) -> float:
        """Standard deviation [m] of the position in its least certain direction."""
        return float(worst_sigma(self.covariance))


@dataclass(frozen=True)
class TagPosterior:
    """Search result of one tag: ``modes``, by descending weight (sum 1); ``reads``: rounds that read it; ``gain``: tempered
    log-likelihood at the best position, relative to a tag out of reach.
    """

    modes: tuple[TagMode, ...]
    reads: int
    gain: float

    @property
    def is_explained(self) -> bool:
        """Whether a position explains the reads significantly better than chance."""
        return bool(self.modes) and self.gain > GAIN

    @property
    def is_ambiguous(self) -> bool:
        """Whether another position is about as likely as the best."""
        return bool(self.modes) and self.modes[0].weight < SURE

    @property
    def is_located(self) -> bool:
        """Whether there is a single mode with a small enough uncertainty."""
        return self.is_explained and not self.is_ambiguous and self.modes[0].sigma < LARGEST_SIGMA


def search(model: RfidModel, counts: TagReadCounts, heights: Array, facing: Array) -> list[TagPosterior]:
    """Search for T tags with ``heights`` (T,) and ``facing`` (T,), NaN where unknown.

    ``counts``: of reads from known poses, relative to the world's origin.
    """
    counts = merged(counts, *FINE)
    uses_facing = any(m.uses_facing for m in model.models)
    nothing = math.log1p(-model.false_read) * counts.rounds.sum()
    reads = counts.hits.sum(axis=0)
    odds = math.log(max(model.false_read, 1e-12)) - math.log1p(-model.false_read)
    nowhere = -model.tempering * (nothing + reads * odds)
    # a tag with fewer reads cannot be located
    searched = -model.tempering * reads * odds > GAIN
    coarse = _lattice_search(
        model, merged(counts, *COARSE), searched, heights, facing if uses_facing else np.full(len(facing), np.nan)
    )
    if uses_facing and np.isnan(facing[coarse.tag]).any():
        between = np.pi / DIRECTIONS * np.where(np.isnan(facing[coarse.tag]), 1.0, 0.0)
        sides = [TagCandidates(coarse.tag, coarse.places, coarse.facing + s * between) for s in (-1.0, 0.0, 1.0)]
        coarse = TagCandidates(*(np.concatenate([getattr(c, n) for c in sides]) for n in ("tag", "places", "facing")))
    fine, nll, covariances = refine(model, counts, heights, coarse)
    out = []
    for t in range(len(heights)):
        mine = np.flatnonzero(fine.tag == t)
        mine = mine[np.argsort(nll[mine], kind="stable")]
        gain = float(nowhere[t] - nll[mine[0]]) if len(mine) else 0.0
        out.append(TagPosterior(_modes(fine[mine], nll[mine], covariances[mine]), int(reads[t]), gain))
    return out


def merged(counts: TagReadCounts, distance: float, angle: float) -> TagReadCounts:
    """Read counts with those of one antenna added up while the robot stays within ``distance`` [m] and ``angle`` [rad]."""
    group = np.empty(len(counts.antennas), dtype=np.int64)
    first: dict[int, int] = {}
    kept: list[int] = []
    for k, antenna in enumerate(counts.antennas.tolist()):
        i = first.get(antenna)
        if i is not None:
            x, y, turned = counts.offsets[k] - counts.offsets[kept[i]]
            if math.hypot(x, y) > distance or abs(wrap_scalar(turned)) > angle:
                i = None
        if i is None:
            i = first[antenna] = len(kept)
            kept.append(k)
        group[k] = i
    rounds = np.zeros(len(kept), dtype=np.int64)
    hits = np.zeros((len(kept), counts.hits.shape[1]), dtype=np.int64)
    np.add.at(rounds, group, counts.rounds)
    np.add.at(hits, group, counts.hits)
    return TagReadCounts(counts.offsets[kept], counts.antennas[kept], rounds, hits)


def _lattice_search(
    model: RfidModel, counts: TagReadCounts, read: NDArray[np.bool_], heights: Array, facing: Array
) -> TagCandidates:
    """The best candidates of each tag that is ``read`` (T,), on a lattice of all places within reach of an antenna."""
    cells = _cells(counts.offsets[:, :2], reach(model))
    uses_facing = any(m.uses_facing for m in model.models)
    free = np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS) if uses_facing else np.array([np.nan])
    levels = np.round(heights / LEVEL)
    tables: list[list[tuple[Array, float]]] = [[] for _ in heights]
    for level in np.unique(levels[read]):
        on_level = read & (levels == level)
        given = [(d, on_level & (facing == d)) for d in np.unique(facing[on_level & np.isfinite(facing)])]
        for direction, wanted in (*given, *((d, on_level & np.isnan(facing)) for d in free)):
            tags = np.flatnonzero(wanted)
            if not len(tags):
                continue
            nll = _nll(model, counts, tags, cells, float(level) * LEVEL, float(direction))
            for column, t in enumerate(tags.tolist()):
                tables[t].append((nll[:, column], float(direction)))
    rows = [(t, *c) for t, table in enumerate(tables) if table for c in _best(cells, table)]
    out = np.array(rows).reshape(-1, 4)
    return TagCandidates(out[:, 0].astype(np.int64), out[:, 1:3], out[:, 3])


def _cells(places: Array, distance: float) -> Array:
    """The lattice points (G, 2) within ``distance`` of any place."""
    low, high = places.min(axis=0) - distance, places.max(axis=0) + distance
    axes = [np.arange(a, b + CELL, CELL) for a, b in zip(low, high, strict=True)]
    x, y = np.meshgrid(*axes, indexing="ij")
    cells = np.column_stack((x.ravel(), y.ravel()))
    coarse = np.unique(np.round(places / CELL), axis=0) * CELL
    near = np.zeros(len(cells), dtype=bool)
    for place in coarse:
        near |= np.sum((cells - place) ** 2, axis=1) < distance**2
    return cells[near]


def _nll(
    model: RfidModel, counts: TagReadCounts, tags: NDArray[np.int64], cells: Array, height: float, direction: float
) -> Array:
    """Tempered negative log-likelihood (G, S) of S ``tags`` at all cells."""
    points = np.column_stack((cells, np.full(len(cells), height)))
    likelihood = RfidLikelihood(model, TagArray(points, np.full(len(cells), direction)))
    out = np.zeros((len(cells), len(tags)))
    for antenna in range(len(model.antennas)):
        mine = np.flatnonzero(counts.antennas == antenna)
        for first in range(0, len(mine), PER_EVALUATION):
            part = mine[first : first + PER_EVALUATION]
            q = np.clip(likelihood.probabilities(counts.offsets[part], antenna), 1e-12, 1.0 - 1e-12)
            missed = np.log1p(-q)
            out -= (counts.rounds[part] @ missed)[:, None]
            hits = counts.hits[np.ix_(part, tags)]
            some = hits.any(axis=1)
            out -= (np.log(q[some]) - missed[some]).T @ hits[some]
    return model.tempering * out


def _best(cells: Array, table: list[tuple[Array, float]]) -> list[tuple[float, float, float]]:
    """The best candidates (x, y, facing), separated from each other."""
    nll = np.stack([column for column, _ in table])
    directions = np.array([direction for _, direction in table])
    out: list[tuple[float, float, float]] = []
    highest = nll.min() + CUT
    for _ in range(CANDIDATES):
        d, g = np.unravel_index(np.argmin(nll), nll.shape)
        if not nll[d, g] < highest:
            break
        out.append((float(cells[g, 0]), float(cells[g, 1]), float(directions[d])))
        near = np.sum((cells - cells[g]) ** 2, axis=1) < APART**2
        turned = np.abs(np.nan_to_num(wrap(directions - directions[d]))) < APART
        nll[np.ix_(turned, near)] = np.inf
    return out


def _modes(optima: TagCandidates, nll: Array, covariances: Array) -> tuple[TagMode, ...]:
    """Optima of one tag, best first, as modes; neighbouring ones, which differ in facing, are merged."""
    kept: list[int] = []
    for i in range(len(nll)):
        apart = np.hypot(*(optima.places[kept] - optima.places[i]).T)
        turned = np.abs(np.nan_to_num(wrap(optima.facing[kept] - optima.facing[i])))
        if not np.any((apart < SAME) & (turned < SAME)):
            kept.append(i)
    if not kept:
        return ()
    weights = np.exp(nll[kept].min() - nll[kept]) * np.sqrt(np.linalg.det(covariances[kept]))
    weights /= weights.sum()
    groups: list[list[int]] = []
    for k, i in enumerate(kept):
        for group in groups:
            head = kept[group[0]]
            off = optima.places[head] - optima.places[i]
            if np.hypot(*off) < MERGED or off @ np.linalg.solve(covariances[head] + covariances[i], off) < OVERLAP:
                group.append(k)
                break
        else:
            groups.append([k])
    out = []
    for group in groups:
        members = [kept[k] for k in group]
        share = (
            weights[group] / weights[group].sum()
            if weights[group].sum() > 0.0
            else np.full(len(group), 1.0 / len(group))
        )
        mean = share @ optima.places[members]
        off = optima.places[members] - mean
        covariance = np.einsum("k,kij->ij", share, covariances[members] + off[:, :, None] * off[:, None, :])
        out.append(
            TagMode(float(weights[group].sum()), mean, covariance, float(optima.facing[members[int(share.argmax())]]))
        )
    return tuple(sorted(out, key=lambda mode: -mode.weight))


def of_tags(counts: TagReadCounts, tags: Integers) -> TagReadCounts:
    """The read counts of some ``tags`` (C,)."""
    return TagReadCounts(counts.offsets, counts.antennas, counts.rounds, np.ascontiguousarray(counts.hits[:, tags]))


def reach(model: RfidModel) -> float:
    """The distance [m] from the robot within which its antennas read."""
    out = 0.0
    bearings = np.linspace(-math.pi, math.pi, 24, endpoint=False)
    for antenna in model.antennas:
        detection = model.models[antenna.model]
        distances = np.arange(0.1, detection.reach, 0.1)
        r, b = np.meshgrid(distances, bearings, indexing="ij")
        points = np.stack((r * np.cos(b), r * np.sin(b), np.zeros_like(r)), axis=-1).reshape(-1, 3)
        p = np.maximum(*(probability(detection, points, c) for c in (0.0, 1.0))).reshape(r.shape).max(axis=1)
        read = np.flatnonzero(p > LEAST)
        out = max(out, math.hypot(antenna.x, antenna.y) + (float(distances[read[-1]]) if len(read) else 0.0))
    return out


def refine(
    model: RfidModel, counts: TagReadCounts, heights: Array, candidates: TagCandidates
) -> tuple[TagCandidates, Array, Array]:
    """TagCandidates at the nearest local optimum, with negative log-likelihood (C,) and covariance (C, 2, 2)."""
    places, nll = candidates.places.copy(), np.empty(len(candidates.tag))
    covariances = np.empty((len(nll), 2, 2))
    prior = np.eye(2) / reach(model) ** 2
    for first in range(0, len(nll), CHUNK):
        part = slice(first, first + CHUNK)
        tag, facing = candidates.tag[part], candidates.facing[part]
        mine = of_tags(counts, tag)
        places[part], nll[part], information = _refined(model, mine, heights[tag], facing, places[part])
        covariances[part] = np.linalg.inv(information + prior)
    return TagCandidates(candidates.tag, places, candidates.facing), nll, covariances


def _refined(
    model: RfidModel, counts: TagReadCounts, heights: Array, facing: Array, places: Array
) -> tuple[Array, Array, Array]:
    """Positions (C, 2) at the optimum, negative log-likelihood (C,) and information (C, 2, 2) of C tags, a column of hits each.

    The information is the observed curvature if it is positive definite, else the Fisher information.
    """

    def at(places: Array, which: Integers) -> tuple[Array, Array, Array]:
        tags = TagArray(np.column_stack((places, heights[which])), facing[which])
        return RfidLikelihood(model, tags).by_tag(np.zeros(3), of_tags(counts, which))

    optima, every = minima(at, places, ITERATIONS, CONVERGED, largest=LARGEST_STEP), np.arange(len(places))
    states, information = optima.states, optima.curvatures
    columns = []
    for off in CURVATURE_STEP * np.eye(2):
        columns.append((at(states + off, every)[1] - at(states - off, every)[1]) / (2.0 * CURVATURE_STEP))
    curvature = np.stack(columns, axis=2)
    curvature = (curvature + curvature.transpose(0, 2, 1)) / 2.0
    good = np.linalg.eigvalsh(curvature)[:, 0] > 0.1 * np.linalg.eigvalsh(information)[:, 0]
    return states, optima.costs, np.where(good[:, None, None], curvature, information)
