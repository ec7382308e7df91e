"""The likelihood of RFID reads and misses for many poses, with gradient and Fisher information.

An antenna reads a tag in k of n inventory rounds with probability q each (:mod:`factors.rfid.model`), so the negative
log-likelihood is ``-tempering * sum(k log q + (n - k) log(1 - q))``. Its Hessian is replaced by the Fisher information, which is
positive semi-definite. A tag that may be dead or moved has a mixture likelihood (:mod:`factors.rfid.tag_states`): gradient and
information are those of a tag as surveyed times the probability that it is so given what was seen, which neglects the information
lost by the unknown state (Louis, JRSS B 44(2), 1982, eq. 3.2').
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.compiled import compiled
from factors.rfid import adjustment, weighing
from factors.rfid import kernels as rfid_kernels
from factors.rfid.counts import TagReadCounts, union
from factors.rfid.index import Corner, TagIndex, near, tag_index, within
from factors.rfid.kernels import terms
from factors.rfid.model import NEGLIGIBLE_LOGIT, Packed, RfidModel
from factors.rfid.places import Places, in_reach
from factors.rfid.tables import Tables, make_tables
from factors.se2 import Array, Integers
from factors.walls import NO_WALLS, walls_around

ROUNDING = 0.02, 0.05  # of the parameters of a detection model, in tables of places
KEPT = 3  # such tables, those of the rig among them
SPARE = 0.5  # m: tags are looked up in a box on a grid of this size, which neighbouring poses share


@dataclass(frozen=True, eq=False)
class TagArray:
    """T tags: ``points`` (T, 3) [m] in the world and ``facing`` (T,) [rad], NaN if unknown. ``walls`` (W, 5): segments between
    which they are, [m], with their attenuation [dB]."""

    points: Array
    facing: Array
    walls: Array = field(default_factory=NO_WALLS.copy)

    @cached_property
    def normals(self) -> Array:
        """The directions (T, 2) in which the tags face, zero if unknown."""
        known = np.isfinite(self.facing)
        angle = np.where(known, self.facing, 0.0)
        return np.where(known[:, None], np.column_stack((np.cos(angle), np.sin(angle))), 0.0)


class Score(NamedTuple):
    """Tempered likelihoods of N poses. ``nll`` (N,); ``gradient`` (N, 3) and ``information`` (N, 3, 3) by body-frame perturbation;
    ``expected`` (N,) and ``variance`` (N,): mean and variance of ``nll`` for a correct model and pose. The variance is proportional
    to the tempering, which accounts for correlated reads."""

    nll: Array
    gradient: Array
    information: Array
    expected: Array
    variance: Array


class NearTags(NamedTuple):
    """Tags that matter to some poses: the ``looks`` at them, and as ``arrays`` points, normals, and those of the looks;
    ``unlisted``: negative log-likelihood, its mean and variance, not tempered, of all others together."""

    looks: TagReadCounts
    arrays: tuple[Array, Array, Array, Integers, Integers, Integers, Array, Array]
    unlisted: tuple[float, float, float]


class _Last(NamedTuple):
    """The tags that mattered last, in a box."""

    looks: TagReadCounts
    box: tuple[Corner, Corner]
    near: NearTags


@dataclass(frozen=True, eq=False)
class RfidLikelihood:
    """The likelihood of an antenna model of M detection models with a map of tags.

    ``parameters`` (2 M,): how the models are adjusted (:mod:`factors.rfid.adjustment`); ``packed``: what compiled code takes.
    """

    model: RfidModel
    tags: TagArray
    packed: Packed = field(init=False, repr=False)
    parameters: Array = field(init=False, repr=False)
    _unadjusted: RfidLikelihood = field(init=False, repr=False)
    _last: list[_Last] = field(init=False, repr=False, default_factory=list)
    _of_parameters: dict[tuple[float, ...], Places] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        packed = self.model.packed()
        walls = walls_around(self.tags.walls, float(packed.reach.max(initial=0.0)))
        object.__setattr__(self, "packed", packed._replace(walls=walls))
        object.__setattr__(self, "parameters", np.zeros(2 * len(self.model.models)))
        object.__setattr__(self, "_unadjusted", self)

    def adjusted(self, parameters: Array) -> RfidLikelihood:
        """The same with other parameters (2 M,) of the detection models."""
        out = copy.copy(self)
        object.__setattr__(out, "packed", adjustment.adjusted(self._unadjusted.packed, parameters))
        object.__setattr__(out, "parameters", np.asarray(parameters, dtype=float))
        return out

    def tempered(self, tempering: float) -> RfidLikelihood:
        """The same with another exponent, for reads that are more or less correlated."""
        out = copy.copy(self)
        object.__setattr__(out, "model", replace(self.model, tempering=tempering))
        return out

    def prepare(self) -> None:
        """Make the tables now, which is done once, and not when they are first needed."""
        for name in ("_tables", "_places"):
            getattr(self._unadjusted, name)

    def joint_score(self, pose: Array, parameters: Array, looks: TagReadCounts) -> Score:
        """Likelihood, gradient (1, 3 + 2 M) and information (1, 3 + 2 M, 3 + 2 M) at one pose (3,), by its body-frame perturbation
        and the ``parameters`` (2 M,) of the detection models."""
        size = 3 + len(parameters)
        gradient, information = np.empty(size), np.empty((size, size))
        packed, pose = adjustment.adjusted(self._unadjusted.packed, parameters), np.asarray(pose, dtype=float)
        near = self.around(pose[None], looks, packed)
        told = adjustment.score(packed, pose, *near.arrays, self.model.tempering, gradient, information)
        others = self.model.tempering * np.array(near.unlisted)
        nll, expected, variance = (np.array([a + b]) for a, b in zip(told, others, strict=True))
        return Score(nll, gradient[None], information[None], expected, variance)

    def score(self, poses: Array, looks: TagReadCounts) -> Score:
        """Likelihood, gradient and information at poses (N, 3)."""
        poses = np.ascontiguousarray(np.atleast_2d(poses), dtype=float)
        n = len(poses)
        out = Score(np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n), np.empty(n))
        near = self.around(poses, looks, self.packed)
        rfid_kernels.score(self.packed, poses, *near.arrays, self.model.tempering, *out)
        nll, expected, variance = self.model.tempering * np.array(near.unlisted)
        return out._replace(nll=out.nll + nll, expected=out.expected + expected, variance=out.variance + variance)

    def around(self, poses: Array, looks: TagReadCounts, packed: Packed, margin: float = 0.0) -> NearTags:
        """The tags that are in reach of poses (N, 3), or of others within a ``margin`` [m] of these, and those that are listed."""
        if looks.tags is None:
            return NearTags(looks, (self.tags.points, self.tags.normals, *looks.arrays), (0.0, 0.0, 0.0))
        # on a grid, so that the same tags count whatever was looked at before: to the last bit, sums depend on them
        box = _box(poses, margin + _reach(packed, looks.offsets, looks.antennas))
        last = self._unadjusted._last
        if last and last[0].looks is looks and last[0].box == box:
            return last[0].near
        tags = union(within(self._unadjusted._index, *box), looks.tags)
        listed = looks.listing(tags)
        of_tags = self.tags.points[tags], self.tags.normals[tags]
        count = len(self.tags.points) - len(tags)
        nll, _, _, mean, spread = terms(packed, NEGLIGIBLE_LOGIT, 1.0, 0, int(looks.rounds.sum()))
        found = NearTags(listed, (*of_tags, *listed.arrays), (count * nll, count * mean, count * spread))
        last[:] = [_Last(looks, box, found)]
        return found

    def displaced(self, poses: Array, looks: TagReadCounts, tags: NDArray[np.int64], shifts: Array) -> Array:
        """Tempered log-likelihood (U, K) of what was seen of U ``tags`` if each were ``shifts`` (K, 2) from where the map has it,
        relative to a silence out of reach: the mean of the likelihood over poses (N, 3)."""
        found = np.empty((len(tags), len(shifts)))
        of_tags = self._of_tags(tags, looks.hits_of(tags))
        weighing.displaced(
            *self._tabled, poses, looks.arrays[:3], of_tags, shifts, self.model.tempering, self.parameters[None], found
        )
        return found

    def log_likelihood(self, poses: Array, looks: TagReadCounts, parameters: Array | None = None) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3), from tables (:mod:`factors.rfid.weighing`, :mod:`factors.rfid.anywhere`):
        for particles.

        ``parameters`` (N, 2 M): of the detection models at each pose, by default its own.
        """
        poses = np.ascontiguousarray(poses, dtype=float)
        if parameters is None and not looks.offsets.any() and self._places.is_wide(poses):
            return self._places.log_likelihood(poses, looks, self.model.tempering)
        parameters = self.parameters[None] if parameters is None else np.ascontiguousarray(parameters)
        packed = self._unadjusted.packed
        largest = float(np.exp(parameters[:, 0::2].max(initial=0.0)))
        around = self.around(poses, looks, packed._replace(reach=largest * packed.reach))
        near = around.looks
        silence = terms(packed, NEGLIGIBLE_LOGIT, 1.0, 0, int(looks.rounds.sum()))[0]
        out = np.full(len(poses), -self.model.tempering * len(self.tags.points) * silence)
        of_tags = self._of_tags(near.listed, near.hits)
        states = near.odds, near.elsewhere
        weighing.add_log_likelihood(
            *self._tabled, poses, near.arrays[:3], of_tags, states, self.model.tempering, parameters, out
        )
        return out

    @property
    def _tabled(self) -> tuple[Packed, Tables]:
        return self._unadjusted.packed, self._unadjusted._tables

    def _of_tags(self, tags: Integers, hits: Integers) -> tuple[Array, Array, Integers, Integers]:
        """Points, normals, tables and ``hits`` (K, U) of U ``tags``."""
        return (
            self.tags.points[tags],
            self.tags.normals[tags],
            np.take(self._unadjusted._tables.level, tags, axis=1),
            hits,
        )

    def reachable(self, poses: Array, looks: TagReadCounts, margin: float) -> NDArray[np.int64]:
        """Places in the map, ascending, of the tags within a ``margin`` [m] of the reach of an antenna from any of the poses."""
        reach = margin + _reach(self.packed, looks.offsets, looks.antennas)
        return near(self._unadjusted._index, self.tags.points, poses, reach)

    @cached_property
    def _index(self) -> TagIndex:
        return tag_index(self.tags.points)

    @cached_property
    def _tables(self) -> Tables:
        return make_tables(self.model, self.packed._replace(walls=None), self.tags.points[:, 2])

    def work(self, looks: TagReadCounts) -> int:
        """How many tags are looked at, by all antennas, to tell the likelihood of one pose among poses that are far apart."""
        return self._unadjusted._places.work(looks)

    @cached_property
    def reached(self) -> float:
        """How many tags are in reach of a pose among them, on average."""
        packed = self._unadjusted.packed
        reach = np.max(packed.reach[packed.which] + np.hypot(*packed.antennas[:, :2].T), initial=0.0)
        return in_reach(self.tags.points[:, :2], float(reach))

    @property
    def _places(self) -> Places:
        """Those of the parameters, which are rounded."""
        steps = np.tile(ROUNDING, len(self.model.models))
        rounded = np.rint(self.parameters / steps)
        kept, key = self._unadjusted._of_parameters, tuple(rounded.tolist())
        if key not in kept:
            if len(kept) >= KEPT:
                del kept[next(k for k in kept if any(k))]
            packed = adjustment.adjusted(self._unadjusted.packed, steps * rounded)
            kept[key] = Places.of(self.model, packed, self._unadjusted._tables, self.tags.points, self.tags.normals)
        return kept[key]

    def by_tag(self, pose: Array, looks: TagReadCounts) -> tuple[Array, Array, Array]:
        """The contribution of each tag, all of the map being listed, at one pose (3,): tempered negative log-likelihood (T,),
        its gradient (T, 2) by the tag's position in the world, and information (T, 2, 2)."""
        count = len(self.tags.points)
        nll, gradient, information = np.zeros(count), np.zeros((count, 2)), np.zeros((count, 2, 2))
        arrays = (looks.offsets, looks.antennas, looks.rounds, looks.hits)
        pose = np.asarray(pose, dtype=float)
        rfid_kernels.by_tag(self.packed, pose, self.tags.points, self.tags.normals, *arrays, nll, gradient, information)
        alpha = self.model.tempering
        return alpha * nll, alpha * gradient, alpha * information

    def expected(self, pose: Array, looks: TagReadCounts) -> tuple[TagReadCounts, Array]:
        """The looks at the tags that are in reach of a pose (3,) or listed, and the probability (K, C) of a read in each."""
        near = self.around(pose[None], looks, self.packed)
        out = np.empty(near.looks.hits.shape)
        for k, antenna in enumerate(looks.antennas.tolist()):
            at = se2.compose(pose, looks.offsets[k])[None]
            rfid_kernels.probabilities(self.packed, antenna, at, *near.arrays[:2], out[k : k + 1])
        return near.looks, out

    def distances(self, pose: Array, looks: TagReadCounts) -> Array:
        """How far [m] the listed tags are from the antenna of each look, in the plane, (K, C), at a pose (3,)."""
        antennas = se2.compose(
            se2.compose(pose, looks.offsets), self.packed.antennas[looks.antennas, :3] * (1.0, 1.0, 0.0)
        )
        away = self.tags.points[looks.listed, :2] - antennas[:, None, :2]
        return np.asarray(np.hypot(away[..., 0], away[..., 1]))

    def probabilities(self, poses: Array, antenna: int) -> Array:
        """Probability (N, T), floor included, that a round of an antenna reads each tag from poses (N, 3)."""
        out = np.empty((len(poses), len(self.tags.points)))
        poses = np.ascontiguousarray(poses, dtype=float)
        rfid_kernels.probabilities(self.packed, antenna, poses, self.tags.points, self.tags.normals, out)
        return out


@compiled
def _reach(packed: Packed, offsets: Array, antennas: Integers) -> float:
    """How far [m] the antennas reach at most from the pose that looks (K,) are relative to."""
    way = farthest = 0.0
    for k in range(len(antennas)):
        way = max(way, math.hypot(offsets[k, 0], offsets[k, 1]))
    for a in range(len(packed.which)):
        lever = math.hypot(packed.antennas[a, 0], packed.antennas[a, 1])
        farthest = max(farthest, packed.reach[packed.which[a]] + lever)
    return way + farthest


@compiled
def _box(poses: Array, reach: float) -> tuple[Corner, Corner]:
    """The corners of the box that holds what is within ``reach`` [m] of poses (N, 3), on the grid."""
    low_x, low_y = poses[:, 0].min() - reach, poses[:, 1].min() - reach
    high_x, high_y = poses[:, 0].max() + reach, poses[:, 1].max() + reach
    low = SPARE * math.floor(low_x / SPARE), SPARE * math.floor(low_y / SPARE)
    return low, (SPARE * math.ceil(high_x / SPARE), SPARE * math.ceil(high_y / SPARE))
