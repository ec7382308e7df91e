"""The likelihood of RFID reads and misses for many poses, with gradient and Fisher information.

An antenna reads a tag in k of n inventory rounds with probability q each (:mod:`factors.rfid.model`), so the negative
log-likelihood is ``-tempering * sum(k log q + (n - k) log(1 - q))``. Its Hessian is replaced by the Fisher information, which is
positive semi-definite. A tag that may be dead has a mixture likelihood (:mod:`factors.rfid.tag_states`): gradient and information
are those of an alive tag times the probability that it is alive given its silence, which neglects the information lost by the
unknown state (Louis, JRSS B 44(2), 1982, eq. 3.2').
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
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
        arrays = (self.tags.points, self.tags.normals, looks.offsets)
        counts = (looks.antennas, looks.rounds, looks.hits)
        packed, pose = adjustment.adjusted(self._unadjusted.packed, parameters), np.asarray(pose, dtype=float)
        tempering = self.model.tempering
        told = adjustment.score(packed, pose, *arrays, *counts, looks.odds, tempering, gradient, information)
        nll, expected, variance = (np.array([value]) for value in told)
        return Score(nll, gradient[None], information[None], expected, variance)

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

    def log_likelihood(self, poses: Array, looks: TagReadCounts, parameters: Array | None = None) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3), from tables (:mod:`factors.rfid.tables`): for particles.

        ``parameters`` (N, 2 M): of the detection models at each pose, by default its own.
        """
        poses = np.ascontiguousarray(poses, dtype=float)
        certain, silent, which = self.by_silence(poses, looks, parameters)
        if len(which):
            add_mixed(silent, looks.odds[which], self.model.tempering, certain)
        return certain

    def by_silence(
        self, poses: Array, looks: TagReadCounts, parameters: Array | None = None
    ) -> tuple[Array, Array32, NDArray[np.int64]]:
        """The log-likelihood at poses (N, 3) in two parts: tempered, of what is certain to live or was read, (N,); and untempered,
        of the silence of U tags that may be dead, each by itself if it is alive, above what it is out of reach, (U, N), with the
        places (U,) of these tags in the map."""
        if parameters is None and self.parameters.any():
            parameters = np.broadcast_to(self.parameters, (len(poses), len(self.parameters)))
        largest = 1.0 if parameters is None else float(np.exp(parameters[:, 0::2].max(initial=0.0)))
        out = np.zeros(len(poses))
        near = self._near(poses, looks, largest)
        which = np.flatnonzero((looks.odds > -np.inf) & ~looks.hits.any(axis=0) & near)
        apart = np.full(len(looks.odds), -1, dtype=np.int64)
        apart[which] = np.arange(len(which))
        silent = np.zeros((len(which), len(poses)), dtype=np.float32)
        for i in range(len(looks.antennas)):
            at = poses if not looks.offsets[i].any() else se2.compose(poses, looks.offsets[i])
            tags = (self.tags.points, self.tags.normals, looks.hits[i], int(looks.rounds[i]))
            antenna = int(looks.antennas[i])
            changes = None if parameters is None else self._changes(parameters, antenna)
            packed, tables = self._unadjusted.packed, self._unadjusted._tables
            add_log_likelihood(packed, tables, antenna, at, *tags, apart, out, silent, changes)
        return self.model.tempering * out, silent, which

    def _changes(self, parameters: Array, antenna: int) -> Changes:
        """What ``parameters`` (N, 2 M) make of the tables of an antenna."""
        packed = self._unadjusted.packed
        m = int(packed.which[antenna])
        logs = self._unadjusted._adjusted_logs[m]
        return Changes(np.exp(-parameters[:, 2 * m]), levels(parameters[:, 2 * m + 1]), logs)

    @cached_property
    def _adjusted_logs(self) -> list[Array32]:
        return [adjusted_logs(self.packed, peak) for peak in self.packed.peak]

    def _near(self, poses: Array, looks: TagReadCounts, largest: float) -> NDArray[np.bool_]:
        """Which tags (T,) may be in reach of an antenna from any of the poses; ``largest``: factor of all ranges."""
        packed = self._unadjusted.packed
        way = float(np.max(np.hypot(looks.offsets[:, 0], looks.offsets[:, 1]), initial=0.0))
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
