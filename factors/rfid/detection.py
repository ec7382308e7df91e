"""The likelihood of RFID reads and misses for many poses, with gradient and Fisher information.

An antenna reads a tag in k of n inventory rounds with probability q each (:mod:`factors.rfid.model`), so the negative
log-likelihood is ``-tempering * sum(k log q + (n - k) log(1 - q))``. Its Hessian is replaced by the Fisher information, which is
positive semi-definite. A tag that may be dead has a mixture likelihood (:mod:`factors.rfid.tag_states`): gradient and information
are those of an alive tag times the probability that it is alive given its silence, which neglects the information lost by the
unknown state (Louis, JRSS B 44(2), 1982, eq. 3.2').
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.rfid import kernels as rfid_kernels
from factors.rfid.model import Packed, RfidModel
from factors.rfid.tables import Array32, Tables, add_log_likelihood, add_mixed, make_tables
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
    log-odds that each tag is dead (:class:`~factors.rfid.tag_states.TagStates`), ``-inf`` for alive, the default.
    """

    offsets: Array
    antennas: NDArray[np.int64]
    rounds: NDArray[np.int64]
    hits: NDArray[np.int64]
    odds: Array = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if not len(self.odds):
            object.__setattr__(self, "odds", np.full(self.hits.shape[1], -np.inf))

    def moved(self, offset: Array) -> TagReadCounts:
        """The counts relative to the pose that lies ``offset`` (3,) before theirs."""
        return TagReadCounts(rfid_kernels.moved(offset, self.offsets), self.antennas, self.rounds, self.hits, self.odds)


def together(parts: list[TagReadCounts]) -> TagReadCounts:
    """Merge counts relative to one pose, in order of time; the odds are those of the first."""
    if len(parts) == 1:
        return parts[0]
    return TagReadCounts(
        np.concatenate([p.offsets for p in parts]),
        np.concatenate([p.antennas for p in parts]),
        np.concatenate([p.rounds for p in parts]),
        np.concatenate([p.hits for p in parts]),
        parts[0].odds,
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
    """The likelihood of an antenna model with a map of tags; ``packed``: the model for compiled code."""

    model: RfidModel
    tags: TagArray
    packed: Packed = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "packed", self.model.packed())

    def score(self, poses: Array, looks: TagReadCounts) -> Score:
        """Likelihood, gradient and information at poses (N, 3)."""
        poses = np.ascontiguousarray(np.atleast_2d(poses), dtype=float)
        n = len(poses)
        out = Score(np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n), np.empty(n))
        tags = (self.tags.points, self.tags.normals)
        where, seen = (looks.offsets, looks.antennas), (looks.rounds, looks.hits)
        rfid_kernels.score(self.packed, poses, *tags, *where, *seen, looks.odds, self.model.tempering, *out)
        return out

    def silence(self, pose: Array, covariance: Array, looks: TagReadCounts) -> Array:
        """Tempered negative log-likelihood (T,) of the silence of uncertain tags if they are alive, at a pose (3,) with body-frame
        ``covariance`` (3, 3), relative to a tag out of range; 0 for tags that were read or are certain."""
        out = np.empty(len(self.tags.points))
        pose, covariance = np.asarray(pose, dtype=float), np.ascontiguousarray(covariance, dtype=float)
        tags, where = (self.tags.points, self.tags.normals), (looks.offsets, looks.antennas)
        seen = (looks.rounds, looks.hits)
        tempering = self.model.tempering
        rfid_kernels.silence(self.packed, pose, covariance, *tags, *where, *seen, looks.odds, tempering, out)
        return out

    def log_likelihood(self, poses: Array, looks: TagReadCounts) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3), from tables (:mod:`factors.rfid.tables`), for particles."""
        poses = np.ascontiguousarray(poses, dtype=float)
        certain, silent, which = self.by_silence(poses, looks)
        if len(which):
            add_mixed(silent, looks.odds[which], self.model.tempering, certain)
        return certain

    def by_silence(self, poses: Array, looks: TagReadCounts) -> tuple[Array, Array32, NDArray[np.int64]]:
        """The log-likelihood at poses (N, 3) in two parts: tempered (N,), of tags that are alive or were read; and untempered (U,
        N), of the silence of each of U uncertain tags if it is alive, relative to a tag out of range, with the indices (U,) of
        these tags in the map."""
        out = np.zeros(len(poses))
        which = np.flatnonzero((looks.odds > -np.inf) & ~looks.hits.any(axis=0) & self._near(poses, looks))
        apart = np.full(len(looks.odds), -1, dtype=np.int64)
        apart[which] = np.arange(len(which))
        silent = np.zeros((len(which), len(poses)), dtype=np.float32)
        for i in range(len(looks.antennas)):
            at = poses if not looks.offsets[i].any() else se2.compose(poses, looks.offsets[i])
            tags = (self.tags.points, self.tags.normals, looks.hits[i], int(looks.rounds[i]))
            add_log_likelihood(self.packed, self._tables, int(looks.antennas[i]), at, *tags, apart, out, silent)
        return self.model.tempering * out, silent, which

    def _near(self, poses: Array, looks: TagReadCounts) -> NDArray[np.bool_]:
        """The tags (T,) that may be in range of an antenna from any of the poses."""
        packed = self.packed
        way = float(np.max(np.hypot(looks.offsets[:, 0], looks.offsets[:, 1]), initial=0.0))
        reach = way + float(np.max(packed.reach[packed.which] + np.hypot(*packed.antennas[:, :2].T)))
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
