"""Search for the positions of tags, given known robot poses. All modes of the likelihood are found, not only the best one.

The likelihood of all antenna observations is evaluated on a lattice, and its best positions are refined by Fisher
scoring. After a straight drive, a tag on the left of the robot may be as likely as a tag on the right. Then there are
two modes. Their weights are computed by Laplace's method under a uniform prior.

If the detection model depends on the facing of a tag and the facing is unknown, :data:`DIRECTIONS` facings are tried on
the lattice, and then intermediate facings near the best ones.
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

CELL = 0.4  # m: spacing of the lattice
LEVEL = 0.2  # m: tags with a smaller difference of height share a lattice
DIRECTIONS = 8  # facings that are tried on the lattice
CANDIDATES = 6  # positions per tag that are refined
CUT = 40.0  # a position is refined if its negative log-likelihood exceeds the minimum on the lattice by at most this value
APART = 0.9  # least distance between candidates: m for positions, rad for facings
SAME = 0.05  # m, rad: optima with smaller differences are equal
# modes are merged if their distance [m] or their squared Mahalanobis distance is smaller
MERGED, OVERLAP = 0.5, 9.0
# m, rad: read counts are added up while the robot moves less than this: in the search on a lattice, in the refinement
COARSE, FINE = (0.2, 0.15), (0.05, 0.03)
# least log-likelihood ratio of a located tag to a tag out of reach; the best position for false reads has a smaller one
GAIN = 8.0
SURE = 0.95  # if the weight of a mode is larger, the other modes are ignored
LARGEST_SIGMA = 1.0  # m: largest standard deviation of a located tag
LEAST = 0.05  # an antenna is in reach of a tag if it reads the tag with at least this probability
ITERATIONS = 30
CONVERGED = 1e-3  # m
LARGEST_STEP = 0.5  # m
CURVATURE_STEP = 0.02  # m: step of the numerical derivatives
CHUNK = 256  # number of candidates in one refinement, to limit the memory
PER_EVALUATION = 2000  # number of observations in one evaluation of the lattice, to limit the memory


@dataclass(frozen=True, eq=False)
class TagCandidates:
    """C candidates for the positions of tags. ``tag`` (C,): index of the tag. ``places`` (C, 2) [m]: its position.
    ``facing`` (C,) [rad]: the direction of its front, NaN if the detection model does not depend on it."""

    tag: Integers
    places: Array
    facing: Array

    def __getitem__(self, which: Integers | NDArray[np.bool_]) -> TagCandidates:
        return TagCandidates(self.tag[which], self.places[which], self.facing[which])


@dataclass(frozen=True)
class TagMode:
    """A mode of the posterior density of a tag's position.

    ``weight``: the probability of this mode. ``position`` (2,) [m] and ``covariance`` (2, 2). ``facing`` [rad]: the
    direction of the tag's front, NaN if unknown.
    """

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
    """The result of the search for the position of one tag.

    ``modes``: by descending weight; the weights sum to 1. ``reads``: the number of inventory rounds that read the tag.
    ``gain``: the log-likelihood ratio of the best position to a position out of reach of all antennas. The ratio is
    reduced by a factor below 1, because reads are correlated.
    """

    modes: tuple[TagMode, ...]
    reads: int
    gain: float

    @property
    def is_explained(self) -> bool:
        """True if the best position explains the reads significantly better than accidental false reads do."""
        return bool(self.modes) and self.gain > GAIN

    @property
    def is_ambiguous(self) -> bool:
        """True if the weight of the best mode is too small to exclude the other modes."""
        return bool(self.modes) and self.modes[0].weight < SURE

    @property
    def is_located(self) -> bool:
        """True if the reads are explained by a single mode with a small enough standard deviation."""
        return self.is_explained and not self.is_ambiguous and self.modes[0].sigma < LARGEST_SIGMA


def search(model: RfidModel, counts: TagReadCounts, heights: Array, facing: Array) -> list[TagPosterior]:
    """Return one search result for the position of each of T tags.

    ``model``: the model of the RFID reader. ``counts``: the reads of these tags, with the robot poses in the world
    frame as ``offsets``. ``heights`` (T,) [m]: of the tags. ``facing`` (T,) [rad]: the directions of the tags' fronts,
    NaN if unknown.
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
    """Return read ``counts`` with consecutive counts of an antenna summed. A new sum begins when the robot is
    more than ``distance`` [m] or ``angle`` [rad] from its pose at the first count."""
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
    """Return the best candidates on a lattice of positions where an antenna can read a tag. ``counts``: the reads of T
    tags, with robot poses in the world frame. ``read`` (T,): mask of the tags to search. ``heights`` (T,) [m],
    ``facing`` (T,) [rad]: height of each tag, and direction of its front, NaN if unknown."""
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
    """Return the lattice points (G, 2) [m] within ``distance`` [m] of one or more of the robot positions ``places``
    (K, 2)."""
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
    """Return the negative log-likelihood (G, S) of the reads of S ``tags`` (indices) at the lattice points ``cells``
    (G, 2). It is multiplied by an exponent below 1, because reads are correlated.

    ``counts``: the reads of all tags. ``height`` [m]: height of the tags. ``direction`` [rad]: direction of their
    fronts.
    """
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
    """Return at most :data:`CANDIDATES` best candidates (x, y, facing) of one tag. Their distances are at least
    :data:`APART`. A facing is the direction [rad] of the tag's front. ``table``: one pair per facing: the negative
    log-likelihoods (G,) at the lattice points ``cells`` (G, 2), and the facing."""
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
    """Return the modes of one tag from its local optima. Equal optima are dropped. Overlapping optima are merged, such
    as optima that differ in facing only.

    ``optima``: C optima, best first. ``nll`` (C,): their negative log-likelihoods. ``covariances`` (C, 2, 2).
    """
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
    """Return the read counts of only the tags with the indices ``tags`` (C,)."""
    return TagReadCounts(counts.offsets, counts.antennas, counts.rounds, np.ascontiguousarray(counts.hits[:, tags]))


def reach(model: RfidModel) -> float:
    """Return the largest distance [m] between robot and tag at which an antenna reads the tag with at least the
    probability :data:`LEAST`."""
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
    """Return C ``candidates``, each moved to the nearest local optimum of the likelihood. Also return their negative
    log-likelihoods (C,) and position covariances (C, 2, 2). ``counts``: the reads of T tags, with robot poses in the
    world frame. ``heights`` (T,) [m]: of the tags."""
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
    """Return positions (C, 2) of C candidates, moved to the nearest local optimum. Also return their negative
    log-likelihoods (C,) and information matrices (C, 2, 2).

    ``counts``: column c of ``hits`` has the reads of candidate c. ``heights``, ``facing`` (C,), ``places`` (C, 2): of
    the candidates. The information is the observed curvature if it is positive definite, otherwise the Fisher
    information.
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
