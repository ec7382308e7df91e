"""The likelihood of what RFID antennas read and did not read, of many poses at once, with gradient and Fisher information.

Each antenna that listens for a tag in n inventory rounds reads it in k of them, with probability q each
(:mod:`factors.rfid`): the negative log-likelihood is ``-tempering * sum(k log q + (n - k) log(1 - q))``. Its Hessian is replaced by
the expected one, Fisher's information, which is never indefinite.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import rfid_kernels, se2
from factors.rfid import Packed, RfidModel
from factors.rfid_tables import Tables, add_log_likelihood, make_tables
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
class Looks:
    """What K antennas read of T tags, each at its own place on the way.

    ``offsets`` (K, 3): the robot's pose at the look, in the frame of the pose that the likelihood is of; ``antennas`` (K,): places
    in the model; ``rounds`` (K,): inventory rounds; ``hits`` (K, T): in how many of them each tag was read.
    """

    offsets: Array
    antennas: NDArray[np.int64]
    rounds: NDArray[np.int64]
    hits: NDArray[np.int64]

    def moved(self, offset: Array) -> Looks:
        """The same looks, of the pose that lies ``offset`` (3,) before theirs."""
        return Looks(rfid_kernels.moved(offset, self.offsets), self.antennas, self.rounds, self.hits)


def together(parts: list[Looks]) -> Looks:
    """Several looks as one, all of the same pose."""
    if len(parts) == 1:
        return parts[0]
    return Looks(
        np.concatenate([p.offsets for p in parts]),
        np.concatenate([p.antennas for p in parts]),
        np.concatenate([p.rounds for p in parts]),
        np.concatenate([p.hits for p in parts]),
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

    def score(self, poses: Array, looks: Looks) -> Score:
        """Likelihood, gradient and information at poses (N, 3)."""
        poses = np.ascontiguousarray(np.atleast_2d(poses), dtype=float)
        n = len(poses)
        out = Score(np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n), np.empty(n))
        tags = (self.tags.points, self.tags.normals)
        where, seen = (looks.offsets, looks.antennas), (looks.rounds, looks.hits)
        rfid_kernels.score(self.packed, poses, *tags, *where, *seen, self.model.tempering, *out)
        return out

    def log_likelihood(self, poses: Array, looks: Looks) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3), from tables (:mod:`factors.rfid_tables`): for particles."""
        out = np.zeros(len(poses))
        poses = np.ascontiguousarray(poses, dtype=float)
        for i in range(len(looks.antennas)):
            at = poses if not looks.offsets[i].any() else se2.compose(poses, looks.offsets[i])
            tags = (self.tags.points, self.tags.normals, looks.hits[i], int(looks.rounds[i]))
            add_log_likelihood(self.packed, self._tables, int(looks.antennas[i]), at, *tags, out)
        return self.model.tempering * out

    @cached_property
    def _tables(self) -> Tables:
        return make_tables(self.model, self.packed, self.tags.points[:, 2])

    def by_tag(self, pose: Array, looks: Looks) -> tuple[Array, Array, Array]:
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
