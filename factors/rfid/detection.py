"""The likelihood of RFID reads and misses for many poses, with gradient and Fisher information.

An antenna reads a tag in k of n inventory rounds with probability q each (:mod:`factors.rfid.model`), so the negative
log-likelihood is ``-tempering * sum(k log q + (n - k) log(1 - q))``. Its Hessian is replaced by the Fisher information, which is
positive semi-definite. A tag that may be dead or moved has a mixture likelihood (:mod:`factors.rfid.tag_states`): gradient and
information are those of a tag as surveyed times the probability that it is so given what was seen, which neglects the information
lost by the unknown state (Louis, JRSS B 44(2), 1982, eq. 3.2').
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.rfid import adjustment
from factors.rfid import kernels as rfid_kernels
from factors.rfid.model import Packed, RfidModel
from factors.rfid.tables import (
    Array32,
    Changes,
    Floats,
    Tables,
    add_log_likelihood,
    add_mixed,
    adjusted_logs,
    levels,
    make_tables,
)
from factors.se2 import Array


@dataclass(frozen=True, eq=False)
class TagArray:
    """T tags: ``points`` (T, 3) [m] in the world and ``facing`` (T,) [rad], NaN if unknown."""

    points: Array
    facing: Array

    @cached_property
    def normals(self) -> Array:
        """The directions (T, 2) in which the tags face, zero if unknown."""
        known = np.isfinite(self.facing)
        angle = np.where(known, self.facing, 0.0)
        return np.where(known[:, None], np.column_stack((np.cos(angle), np.sin(angle))), 0.0)


@dataclass(frozen=True, eq=False)
class TagReadCounts:
    """Read counts of T tags by K antennas, each at its own pose.

    ``offsets`` (K, 3): the robot's pose at the measurement, in the frame of the likelihood's pose; ``antennas`` (K,): indices in
    the model; ``rounds`` (K,): inventory rounds; ``hits`` (K, T): number of rounds that read each tag. ``odds`` (T,): prior
    log-odds that each tag is dead or moved (:class:`~factors.rfid.tag_states.TagStates`), ``-inf`` for as surveyed, the default.
    ``elsewhere`` (T,): tempered log-likelihood of what was seen of the tag if so, relative to a silence out of reach; by default
    that of a dead tag: 0, or ``-inf`` if it was read.
    """

    offsets: Array
    antennas: NDArray[np.int64]
    rounds: NDArray[np.int64]
    hits: NDArray[np.int64]
    odds: Array = field(default_factory=lambda: np.empty(0))
    elsewhere: Array = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if not len(self.odds):
            object.__setattr__(self, "odds", np.full(self.hits.shape[1], -np.inf))
        if not len(self.elsewhere):
            object.__setattr__(self, "elsewhere", np.where(self.hits.any(axis=0), -np.inf, 0.0))

    def moved(self, offset: Array) -> TagReadCounts:
        """The counts relative to the pose that lies ``offset`` (3,) before theirs."""
        return replace(self, offsets=rfid_kernels.moved(offset, self.offsets))


def together(parts: list[TagReadCounts]) -> TagReadCounts:
    """Merge counts relative to one pose, in order of time; the odds are those of the first, what they tell of tags adds up."""
    if len(parts) == 1:
        return parts[0]
    return TagReadCounts(
        np.concatenate([p.offsets for p in parts]),
        np.concatenate([p.antennas for p in parts]),
        np.concatenate([p.rounds for p in parts]),
        np.concatenate([p.hits for p in parts]),
        parts[0].odds,
        np.sum([p.elsewhere for p in parts], axis=0),
    )


class Score(NamedTuple):
    """Tempered likelihoods of N poses. ``nll`` (N,); ``gradient`` (N, 3) and ``information`` (N, 3, 3) by body-frame perturbation;
    ``expected`` (N,) and ``variance`` (N,): mean and variance of ``nll`` for a correct model and pose. The variance is proportional
    to the tempering, which accounts for correlated reads."""

    nll: Array
    gradient: Array
    information: Array
    expected: Array
    variance: Array


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

    def __post_init__(self) -> None:
        object.__setattr__(self, "packed", self.model.packed())
        object.__setattr__(self, "parameters", np.zeros(2 * len(self.model.models)))
        object.__setattr__(self, "_unadjusted", self)

    def adjusted(self, parameters: Array) -> RfidLikelihood:
        """The same with other parameters (2 M,) of the detection models."""
        out = copy.copy(self)
        object.__setattr__(out, "packed", adjustment.adjusted(self._unadjusted.packed, parameters))
        object.__setattr__(out, "parameters", np.asarray(parameters, dtype=float))
        return out

    def joint_score(self, pose: Array, parameters: Array, looks: TagReadCounts) -> Score:
        """Likelihood, gradient (1, 3 + 2 M) and information (1, 3 + 2 M, 3 + 2 M) at one pose (3,), by its body-frame perturbation
        and the ``parameters`` (2 M,) of the detection models."""
        size = 3 + len(parameters)
        gradient, information = np.empty(size), np.empty((size, size))
        tags = (self.tags.points, self.tags.normals)
        where, seen, states = (looks.offsets, looks.antennas), (looks.rounds, looks.hits), (looks.odds, looks.elsewhere)
        packed, pose = adjustment.adjusted(self._unadjusted.packed, parameters), np.asarray(pose, dtype=float)
        tempering = self.model.tempering
        told = adjustment.score(packed, pose, *tags, *where, *seen, *states, tempering, gradient, information)
        nll, expected, variance = (np.array([value]) for value in told)
        return Score(nll, gradient[None], information[None], expected, variance)

    def score(self, poses: Array, looks: TagReadCounts) -> Score:
        """Likelihood, gradient and information at poses (N, 3)."""
        poses = np.ascontiguousarray(np.atleast_2d(poses), dtype=float)
        n = len(poses)
        out = Score(np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n), np.empty(n))
        tags = (self.tags.points, self.tags.normals)
        where, seen, states = (looks.offsets, looks.antennas), (looks.rounds, looks.hits), (looks.odds, looks.elsewhere)
        rfid_kernels.score(self.packed, poses, *tags, *where, *seen, *states, self.model.tempering, *out)
        return out

    def displaced(self, poses: Array, looks: TagReadCounts, tags: NDArray[np.int64], shifts: Array) -> Array:
        """Tempered log-likelihood (U, K) of what was seen of U ``tags`` if each were ``shifts`` (K, 2) from where the map has it,
        relative to a silence out of reach: the mean of the likelihood over poses (N, 3)."""
        count = len(tags) * len(shifts)
        points = np.repeat(self.tags.points[tags], len(shifts), axis=0)
        points[:, :2] += np.tile(shifts, (len(tags), 1))
        array = TagArray(points, np.repeat(self.tags.facing[tags], len(shifts)))
        hits = np.repeat(looks.hits[:, tags], len(shifts), axis=1)
        level = np.repeat(self._unadjusted._tables.level[:, tags], len(shifts), axis=1)
        # in double precision, as the last bit of a single decides in which cell of a table a tag is
        each = np.zeros((count, len(poses)))
        tables = self._unadjusted._tables._replace(level=level)
        self._add(
            poses,
            replace(looks, hits=hits),
            array,
            tables,
            np.arange(count),
            np.zeros(len(poses)),
            each,
            self._of_poses(len(poses)),
        )
        found = self.model.tempering * each
        most = found.max(axis=1)
        mean = most + np.log(np.mean(np.exp(found - most[:, None]), axis=1))
        return np.asarray(mean.reshape(len(tags), len(shifts)))

    def log_likelihood(self, poses: Array, looks: TagReadCounts, parameters: Array | None = None) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3), from tables (:mod:`factors.rfid.tables`): for particles.

        ``parameters`` (N, 2 M): of the detection models at each pose, by default its own.
        """
        poses = np.ascontiguousarray(poses, dtype=float)
        certain, uncertain, which = self._by_certainty(poses, looks, parameters)
        if len(which):
            add_mixed(uncertain, looks.odds[which], looks.elsewhere[which], self.model.tempering, certain)
        return certain

    def _by_certainty(
        self, poses: Array, looks: TagReadCounts, parameters: Array | None
    ) -> tuple[Array, Array32, NDArray[np.int64]]:
        """The log-likelihood at poses (N, 3) in two parts: tempered, of what is certain to be as surveyed, (N,); and untempered, of
        U tags that may not be, each by itself if it is, above that of a silence out of reach, (U, N), with the places (U,) of these
        tags in the map."""
        if parameters is None:
            parameters = self._of_poses(len(poses))
        largest = 1.0 if parameters is None else float(np.exp(parameters[:, 0::2].max(initial=0.0)))
        out = np.zeros(len(poses))
        near = self.near(poses, looks, largest) | looks.hits.any(axis=0)
        which = np.flatnonzero((looks.odds > -np.inf) & (looks.elsewhere > -np.inf) & near)
        apart = np.full(len(looks.odds), -1, dtype=np.int64)
        apart[which] = np.arange(len(which))
        each = np.zeros((len(which), len(poses)), dtype=np.float32)
        self._add(poses, looks, self.tags, self._unadjusted._tables, apart, out, each, parameters)
        return self.model.tempering * out, each, which

    def _add(
        self,
        poses: Array,
        looks: TagReadCounts,
        tags: TagArray,
        tables: Tables,
        apart: NDArray[np.int64],
        out: Array,
        each: Floats,
        parameters: Array | None,
    ) -> None:
        """Add all looks at ``tags``, see :func:`~factors.rfid.tables.add_log_likelihood`."""
        packed = self._unadjusted.packed
        for i in range(len(looks.antennas)):
            at = poses if not looks.offsets[i].any() else se2.compose(poses, looks.offsets[i])
            seen = (tags.points, tags.normals, looks.hits[i], int(looks.rounds[i]))
            antenna = int(looks.antennas[i])
            changes = None if parameters is None else self._changes(parameters, antenna)
            add_log_likelihood(packed, tables, antenna, at, *seen, apart, out, each, changes)

    def _of_poses(self, count: int) -> Array | None:
        """The parameters (N, 2 M), the same at ``count`` poses; None where they change nothing."""
        return np.broadcast_to(self.parameters, (count, len(self.parameters))) if self.parameters.any() else None

    def _changes(self, parameters: Array, antenna: int) -> Changes:
        """What ``parameters`` (N, 2 M) make of the tables of an antenna."""
        packed = self._unadjusted.packed
        m = int(packed.which[antenna])
        logs = self._unadjusted._adjusted_logs[m]
        return Changes(np.exp(-parameters[:, 2 * m]), levels(parameters[:, 2 * m + 1]), logs)

    @cached_property
    def _adjusted_logs(self) -> list[Array32]:
        return [adjusted_logs(self.packed, peak) for peak in self.packed.peak]

    def near(self, poses: Array, looks: TagReadCounts, largest: float = 1.0, margin: float = 0.0) -> NDArray[np.bool_]:
        """Which tags (T,) may be in reach of an antenna from any of the poses, within a ``margin`` [m]; ``largest``: factor of all
        ranges."""
        packed = self._unadjusted.packed
        way = margin + float(np.max(np.hypot(looks.offsets[:, 0], looks.offsets[:, 1]), initial=0.0))
        reach = way + float(np.max(largest * packed.reach[packed.which] + np.hypot(*packed.antennas[:, :2].T)))
        low, high = poses[:, :2].min(axis=0), poses[:, :2].max(axis=0)
        return np.asarray(
            np.all((self.tags.points[:, :2] > low - reach) & (self.tags.points[:, :2] < high + reach), axis=1)
        )

    @cached_property
    def _tables(self) -> Tables:
        return make_tables(self.model, self.packed, self.tags.points[:, 2])

    def by_tag(self, pose: Array, looks: TagReadCounts) -> tuple[Array, Array, Array]:
        """The contribution of each tag at one pose (3,): tempered negative log-likelihood (T,), its gradient (T, 2) by the tag's
        position in the world, and information (T, 2, 2)."""
        count = len(self.tags.points)
        nll, gradient, information = np.zeros(count), np.zeros((count, 2)), np.zeros((count, 2, 2))
        arrays = (looks.offsets, looks.antennas, looks.rounds, looks.hits)
        pose = np.asarray(pose, dtype=float)
        rfid_kernels.by_tag(self.packed, pose, self.tags.points, self.tags.normals, *arrays, nll, gradient, information)
        alpha = self.model.tempering
        return alpha * nll, alpha * gradient, alpha * information

    def probabilities(self, poses: Array, antenna: int) -> Array:
        """Probability (N, T), floor included, that a round of an antenna reads each tag from poses (N, 3)."""
        out = np.empty((len(poses), len(self.tags.points)))
        poses = np.ascontiguousarray(poses, dtype=float)
        rfid_kernels.probabilities(self.packed, antenna, poses, self.tags.points, self.tags.normals, out)
        return out
