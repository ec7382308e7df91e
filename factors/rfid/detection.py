"""The likelihood of what RFID antennas read and did not read, of many poses at once, with gradient and Fisher information.

Each antenna that listens for a tag in n inventory rounds reads it in k of them, with probability q each
(:mod:`factors.rfid.model`): the negative log-likelihood is ``-tempering * sum(k log q + (n - k) log(1 - q))``. Its Hessian is
replaced by the expected one, Fisher's information, which is never indefinite. A tag that may be dead counts by a mixture
(:mod:`factors.rfid.tag_states`): its gradient and its information are those of an alive tag, times the probability that it is alive
given that it is silent; of the Hessian of the mixture that leaves out what the state, not being known, takes away (Louis, JRSS B
44(2), 1982, eq. 3.2').
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
    """T tags: ``points`` (T, 3) [m] in the world and ``facing`` (T,) [rad], NaN where it is not known."""

    points: Array
    facing: Array

    @cached_property
    def normals(self) -> Array:
        """The directions (T, 2) in which the tags face, zero where that is not known."""
        known = np.isfinite(self.facing)
        angle = np.where(known, self.facing, 0.0)
        return np.where(known[:, None], np.column_stack((np.cos(angle), np.sin(angle))), 0.0)


@dataclass(frozen=True, eq=False)
class TagReadCounts:
    """What K antennas read of T tags, each at its own place on the way.

    ``offsets`` (K, 3): the robot's pose at the look, in the frame of the pose that the likelihood is of; ``antennas`` (K,): places
    in the model; ``rounds`` (K,): inventory rounds; ``hits`` (K, T): in how many of them each tag was read. ``odds`` (T,): log-odds
    before these looks that each tag is dead, against alive (:class:`~factors.rfid.tag_states.TagStates`), ``-inf`` where it
    lives, as by default all do.
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
        """The same looks, of the pose that lies ``offset`` (3,) before theirs."""
        return TagReadCounts(rfid_kernels.moved(offset, self.offsets), self.antennas, self.rounds, self.hits, self.odds)


def together(parts: list[TagReadCounts]) -> TagReadCounts:
    """Several looks as one, all of the same pose, in the order in which they were made: the odds are those before the first."""
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
    """Of N poses, all tempered. ``nll`` (N,); ``gradient`` (N, 3) and ``information`` (N, 3, 3) by body-frame perturbation;
    ``expected`` (N,) and ``variance`` (N,): mean and variance of ``nll`` if model and pose are right. The variance too is in
    proportion to the tempering, which stands for how much the reads go together."""

    nll: Array
    gradient: Array
    information: Array
    expected: Array
    variance: Array


@dataclass(frozen=True, eq=False)
class RfidLikelihood:
    """The likelihood of an antenna model with a map of tags; ``packed``: the model as compiled code takes it."""

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
        """Tempered negative log-likelihood (T,), if they are alive, that tags of which that is not certain were not read, from a
        pose (3,) with body-frame ``covariance`` (3, 3); less what it is out of reach, and 0 where a tag was read or is certain."""
        out = np.empty(len(self.tags.points))
        pose, covariance = np.asarray(pose, dtype=float), np.ascontiguousarray(covariance, dtype=float)
        tags, where = (self.tags.points, self.tags.normals), (looks.offsets, looks.antennas)
        seen = (looks.rounds, looks.hits)
        tempering = self.model.tempering
        rfid_kernels.silence(self.packed, pose, covariance, *tags, *where, *seen, looks.odds, tempering, out)
        return out

    def log_likelihood(self, poses: Array, looks: TagReadCounts) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3), from tables (:mod:`factors.rfid.tables`): for particles."""
        poses = np.ascontiguousarray(poses, dtype=float)
        certain, silent, which = self.by_silence(poses, looks)
        if len(which):
            add_mixed(silent, looks.odds[which], self.model.tempering, certain)
        return certain

    def by_silence(self, poses: Array, looks: TagReadCounts) -> tuple[Array, Array32, NDArray[np.int64]]:
        """The log-likelihood at poses (N, 3) in two parts: tempered, of what is certain to live or was read, (N,); and untempered,
        of the silence of U tags that may be dead, each by itself if it is alive, above what it is out of reach, (U, N), with the
        places (U,) of these tags in the map."""
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
        """Which tags (T,) may be in reach of an antenna from any of the poses."""
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
        """What each tag says on its own, at one pose (3,): tempered negative log-likelihood (T,), its gradient (T, 2) by the tag's
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
