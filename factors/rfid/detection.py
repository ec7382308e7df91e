"""The likelihood of RFID reads and misses with a map of tags.

For Gaussian states and graphs the likelihood is exact and has derivatives (:mod:`factors.rfid.kernels`). For particles
it comes from tables, without derivatives. The log-likelihood is tempered: it is multiplied by an exponent below 1,
because reads are correlated. The likelihood of a tag that may be dead, weak or moved is a mixture
(:mod:`factors.rfid.tag_states`).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.rfid import kernels, tag_states, weighing
from factors.rfid.index import Counts, MapTags, moved, tag_index
from factors.rfid.model import Packed, RfidModel
from factors.rfid.mounting import reach_of
from factors.rfid.parameters import adjusted
from factors.rfid.places import BY_ANTENNA, PLACED, Places, RobotTables, antennas_of, in_reach, is_wide, robot_tables
from factors.rfid.tables import Tables, make_tables
from factors.se2 import Array, Integers


@dataclass(frozen=True, eq=False)
class TagArray:
    """T tags in the world, or on a robot. ``points`` (T, 3) [m]: positions in the world, or in the robot frame.
    ``facing`` (T,) [rad]: the direction of each tag's front in the horizontal plane of that frame, NaN if unknown."""

    points: Array
    facing: Array

    @cached_property
    def normals(self) -> Array:
        """The directions of the tags' fronts as unit vectors (T, 2), zero if unknown."""
        known = np.isfinite(self.facing)
        angle = np.where(known, self.facing, 0.0)
        return np.where(known[:, None], np.column_stack((np.cos(angle), np.sin(angle))), 0.0)


@dataclass(frozen=True, eq=False)
class TagReadCounts:
    """The reads of tags in K measurements. A measurement is a number of inventory rounds of one antenna at one pose.

    ``offsets`` (K, 3): the robot's pose at each measurement, in the frame of a reference pose.
    ``antennas`` (K,): indices of the antennas in the model. ``rounds`` (K,): numbers of inventory rounds.
    ``hits`` (K, C): the number of rounds that read each of C listed tags. Tags that are not listed were not read.
    ``odds`` (C,): the prior log-odds that a listed tag is weak (seldom read), moved or dead, from
    :class:`~factors.rfid.tag_states.TagStates`. The default ``-inf`` means that the tag certainly is as in the map.
    ``elsewhere`` (C,): the tempered log-likelihood of the reads of a tag that is weak, moved or dead. It is relative to
    that of a tag out of reach without reads. The default is that of a dead tag: 0, or ``-inf`` if the tag was read.
    ``tags`` (C,): indices in the map of the listed tags, ascending. The default is all tags of the map.
    ``unlisted_odds``: the odds of tags that are not listed.
    ``twists`` (K, 3): the robot's body-frame velocity [m/s, m/s, rad/s] at each measurement. The default is zero.
    """

    offsets: Array
    antennas: NDArray[np.int64]
    rounds: NDArray[np.int64]
    hits: NDArray[np.int64]
    odds: Array = field(default_factory=lambda: np.empty(0))
    elsewhere: Array = field(default_factory=lambda: np.empty(0))
    tags: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    unlisted_odds: float = -np.inf
    twists: Array = field(default_factory=lambda: np.empty((0, 3)))

    def __post_init__(self) -> None:
        if not len(self.tags):
            object.__setattr__(self, "tags", np.arange(self.hits.shape[1]))
        if not len(self.odds):
            object.__setattr__(self, "odds", np.full(self.hits.shape[1], -np.inf))
        if not len(self.elsewhere):
            object.__setattr__(self, "elsewhere", np.where(self.hits.any(axis=0), -np.inf, 0.0))
        if not len(self.twists):
            object.__setattr__(self, "twists", np.zeros(self.offsets.shape))

    @cached_property
    def packed(self) -> Counts:
        """The fields of the counts as a tuple, for compiled code."""
        counts = self.offsets, self.antennas, self.rounds, self.hits
        return (*counts, self.odds, self.elsewhere, self.tags, self.unlisted_odds, self.twists)

    @property
    def read_tags(self) -> Integers:
        """The indices in the map of the tags that were read, ascending."""
        return np.asarray(self.tags[self.hits.any(axis=0)])

    def with_states(self, tags: Integers, odds: Array, elsewhere: Array) -> TagReadCounts:
        """Return the counts with new values of ``odds`` (U,) and ``elsewhere`` (U,) for ``tags`` (U,), indices in the
        map. Tags that are not listed yet are added to the listed tags."""
        both = np.union1d(self.tags, tags)
        hits = np.zeros((len(self.hits), len(both)), dtype=np.int64)
        all_odds, all_elsewhere = np.full(len(both), self.unlisted_odds), np.zeros(len(both))
        rows = (self.tags, self.odds, self.elsewhere), (tags, odds, elsewhere)
        hits[:, np.searchsorted(both, self.tags)] = self.hits
        for chosen, own_odds, own_elsewhere in rows:
            at = np.searchsorted(both, chosen)
            all_odds[at], all_elsewhere[at] = own_odds, own_elsewhere
        return replace(self, hits=hits, odds=all_odds, elsewhere=all_elsewhere, tags=both)

    def moved(self, offset: Array) -> TagReadCounts:
        """Return the counts relative to a new reference pose. ``offset`` (3,): the old reference pose in the frame of
        the new reference pose."""
        return replace(self, offsets=moved(offset, self.offsets))


def merged(parts: list[TagReadCounts]) -> TagReadCounts:
    """Merge counts with the same reference pose into one. ``parts``: counts in order of time. The ``odds`` of a tag are
    those of the first part that lists the tag. The values ``elsewhere`` of a tag are added."""
    first = parts[0]
    if len(parts) == 1:
        return first
    tags = np.unique(np.concatenate([p.tags for p in parts]))
    odds, elsewhere, hits = np.full(len(tags), first.unlisted_odds), np.zeros(len(tags)), []
    for part in reversed(parts):
        at, own = np.searchsorted(tags, part.tags), np.zeros((len(part.hits), len(tags)), dtype=np.int64)
        own[:, at] = part.hits
        odds[at] = part.odds
        elsewhere[at] += part.elsewhere
        hits.append(own)
    rows = zip(*[(p.offsets, p.antennas, p.rounds, p.twists) for p in parts], strict=True)
    offsets, antennas, rounds, twists = map(np.concatenate, rows)
    counts = offsets, antennas, rounds, np.concatenate(hits[::-1])
    return TagReadCounts(*counts, odds, elsewhere, tags, first.unlisted_odds, twists)


class Score(NamedTuple):
    """The tempered likelihood of a measurement at N poses, with derivatives.

    ``nll`` (N,): the negative log-likelihood, multiplied by the tempering exponent.
    ``gradient`` (N, 3): its derivative by the body-frame perturbation of the pose. ``information`` (N, 3, 3): its
    Fisher information.
    ``expected`` (N,), ``variance`` (N,): mean and variance of ``nll`` over all outcomes, if model and pose are correct.
    """

    nll: Array
    gradient: Array
    information: Array
    expected: Array
    variance: Array

    @classmethod
    def of_signals(cls, nll: Array, gradient: Array, information: Array) -> Score:
        """Return the score of signal strengths or phases with these fields. ``expected`` is ``nll``, ``variance`` is
        0."""
        return cls(nll, gradient, information, nll, np.zeros(len(nll)))


class ExpectedReads(NamedTuple):
    """Observed and predicted reads of C tags in K measurements, each of several inventory rounds of one antenna.

    ``tags`` (C,): indices in the map. ``hits`` (K, C): numbers of reads. ``p`` (K, C): probability that one round reads
    the tag. ``distance`` (K, C) [m]: horizontal distance from antenna to tag.
    """

    tags: Integers
    hits: Integers
    p: Array
    distance: Array


@dataclass(frozen=True, eq=False)
class RfidLikelihood:
    """The likelihood of RFID read counts as a function of the robot's pose.

    ``model``: the antennas and their detection models. ``tags``: the tags of the map, or the tags on the robot if the
    antennas of the model are fixed in the world. ``parameters`` (Q,): calibration of detection models, mounting and
    clock, initially zero. With M detection models and A antennas, Q is 2 M + A + 2. See :mod:`factors.rfid.parameters`.
    """

    model: RfidModel
    tags: TagArray
    parameters: Array = field(init=False, repr=False)
    _unadjusted: RfidLikelihood = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", np.zeros(2 * len(self.model.models) + len(self.model.antennas) + 2))
        object.__setattr__(self, "_unadjusted", self)

    def adjusted(self, parameters: Array) -> RfidLikelihood:
        """Return the likelihood with other calibration ``parameters`` (Q,). Raises ValueError for a wrong number."""
        parameters, out = np.asarray(parameters, dtype=float), copy.copy(self)
        if parameters.shape != self.parameters.shape:
            raise ValueError(
                f"parameters of an RFID likelihood have shape {parameters.shape}, expected {self.parameters.shape}"
            )
        out.__dict__.pop("packed", None)
        object.__setattr__(out, "parameters", parameters)
        return out

    def tempered(self, tempering: float) -> RfidLikelihood:
        """Return the likelihood with another tempering exponent."""
        out = copy.copy(self)
        object.__setattr__(out, "model", replace(self.model, tempering=tempering))
        return out

    def prepare(self) -> None:
        """Compute the tables of :meth:`log_likelihood` now, to avoid a delay in the first call of that method."""
        for name in ("_tables",) if self.model.fixed else ("_tables", "_places"):
            getattr(self._unadjusted, name)

    @cached_property
    def packed(self) -> Packed:
        """The detection models with the ``parameters`` applied, as a tuple of arrays for compiled code."""
        if self._unadjusted is self:
            return self.model.packed()
        return adjusted(self._unadjusted.packed, self.parameters)

    @cached_property
    def arrays(self) -> tuple[Packed, MapTags]:
        """The detection models without the ``parameters`` of the likelihood, and the tags of the map, as tuples of
        arrays for compiled code."""
        return self._unadjusted.packed, self._unadjusted._map

    def joint_score(
        self, pose: Array, parameters: Array, counts: TagReadCounts, estimated: Sequence[int] | None = None
    ) -> Score:
        """Return the tempered likelihood of ``counts`` at one pose (3,) and ``parameters`` (Q,), with derivatives.

        ``estimated`` (P,): the indices of the parameters that derivatives are computed for. None means all. The
        gradient has the shape (1, 3 + P), the information (1, 3 + P, 3 + P). The first three components are the
        body-frame perturbation of the pose, the others are these parameters.
        """
        places = np.array(range(len(parameters)) if estimated is None else estimated, dtype=np.int64)
        pose, alpha = np.ascontiguousarray(pose, dtype=float), float(self.model.tempering)
        packed = *self.arrays, counts.packed
        nll, gradient, information, *moments = kernels.score(*packed, alpha, pose, parameters, places)
        expected, variance = np.array(moments)[:, None]
        return Score(np.array((nll,)), gradient[None], information[None], expected, variance)

    def score(self, poses: Array, counts: TagReadCounts) -> Score:
        """Return the tempered negative log-likelihood of ``counts`` at poses (N, 3), with derivatives by the poses."""
        poses = np.ascontiguousarray(np.atleast_2d(poses), dtype=float)
        no_columns = np.full(len(self.parameters), -1, dtype=np.int64)
        alpha = float(self.model.tempering)
        return Score(*kernels.scores(self.packed, self.arrays[1], counts.packed, alpha, poses, no_columns))

    def displaced(
        self, poses: Array, counts: TagReadCounts, hypotheses: Array, margin: float, parameters: Array, odds: Array
    ) -> tuple[Integers, Array, NDArray[np.bool_]]:
        """Return three arrays about possible states of tags, such as weak or moved. They are the indices (U,) of the
        tags, the log-likelihoods (U, S) of S states of each tag, and a mask (U,) of the tags that were read.

        ``counts``: the reads. ``poses`` (N, 3): possible robot poses. The likelihood is the mean over all poses.
        ``hypotheses`` (S, 4): the states, from :func:`factors.rfid.tag_states.hypotheses`.
        ``margin`` [m]: tags that are farther than :attr:`reach` plus margin from all poses are left out, unless they
        were read.
        ``parameters`` (Q,): parameters of the likelihood. ``odds`` (T,): the prior log-odds that each tag of the map is
        in one of these states. Tags with ``-inf`` are left out.

        The log-likelihoods are tempered, and relative to that of a tag out of reach that is never read.
        """
        alpha = float(self.model.tempering)
        return tag_states.displaced(*self._tabled, counts.packed, poses, margin, odds, hypotheses, alpha, parameters)

    def log_likelihood(self, poses: Array, counts: TagReadCounts, parameters: Array | None = None) -> Array:
        """Return the tempered log-likelihood (N,) of ``counts`` for particles at poses (N, 3), interpolated in tables.

        ``parameters`` (N, Q): the parameters of each particle, by default :attr:`parameters`. Limitation: if particles
        differ in their time offset, the velocity of the first measurement is used for all measurements.
        """
        poses = np.ascontiguousarray(poses, dtype=float)
        unchanged = parameters is None and not (self.parameters.any() or counts.offsets.any() or self.model.fixed)
        if unchanged and is_wide(poses, self.reach):
            return self._unadjusted._places.log_likelihood(poses, counts.packed, self.model.tempering)
        parameters = self.parameters[None] if parameters is None else np.ascontiguousarray(parameters)
        return weighing.log_likelihood(*self._tabled, counts.packed, poses, float(self.model.tempering), parameters)

    @cached_property
    def _tabled(self) -> tuple[Packed, Tables, MapTags]:
        return self._unadjusted.packed, self._unadjusted._tables, self._unadjusted._map

    @cached_property
    def _map(self) -> MapTags:
        points = np.ascontiguousarray(self.tags.points, dtype=float)
        return MapTags(tag_index(points), points, np.ascontiguousarray(self.tags.normals))

    @cached_property
    def _tables(self) -> Tables:
        return make_tables(self.model, self.packed, self.tags.points[:, 2])

    def work(self, counts: TagReadCounts) -> int:
        """Return the approximate computing time per pose of :meth:`log_likelihood`, in evaluations of one tag in
        ``counts``."""
        if self.model.fixed:
            return PLACED + BY_ANTENNA * len(counts.antennas) * len(self.tags.points)
        return self._unadjusted._places.work(counts.packed)

    @property
    def reach(self) -> float:
        """The largest distance [m] from the robot's origin at which an antenna can read a tag."""
        return reach_of(self.packed, np.zeros((0, 3)))

    @cached_property
    def reached(self) -> float:
        """The mean number of tags in reach of a robot, for robot positions uniform in the bounding box of the tags. If
        the tags are on the robot, their number."""
        if self.model.fixed:
            return float(len(self.tags.points))
        return in_reach(self.tags.points[:, :2], self._unadjusted.reach)

    @cached_property
    def _places(self) -> Places:
        return Places.of(antennas_of(self.packed, self._tables), self._map, uses_facing=self.uses_facing)

    @property
    def uses_facing(self) -> bool:
        """True if the read probability of any antenna depends on the direction of the tags' fronts."""
        return any(self.model.models[a.model].uses_facing for a in self.model.antennas)

    def robot_tables(self, finest: int, facings: int) -> RobotTables:
        """Return tables of the read probability of each antenna over the tag's position in the robot frame. ``finest``:
        the cell size, as a multiple of the smallest one. ``facings``: the number of directions of the tag's front."""
        antennas = antennas_of(self.packed, self._unadjusted._tables)
        return robot_tables(antennas, self.tags.points[:, 2], finest, facings if self.uses_facing else 0)

    def by_tag(self, pose: Array, counts: TagReadCounts) -> tuple[Array, Array, Array]:
        """Return three arrays about the reads of each tag at one robot pose (3,): tempered negative log-likelihood
        (T,), its gradient (T, 2) by the tag's world position, and its Fisher information (T, 2, 2). ``counts``: all
        tags listed."""
        arrays, alpha = counts.packed[:4], self.model.tempering
        pose = np.asarray(pose, dtype=float)
        nll, slope, curve = kernels.by_tag(self.packed, pose, self.tags.points, self.tags.normals, *arrays)
        return alpha * nll, alpha * slope[:, 3:], alpha * curve[:, 3:, 3:]

    def expected(self, pose: Array, counts: TagReadCounts, parameters: Array) -> ExpectedReads:
        """Return the observed and predicted reads of all tags that are in reach of a robot at ``pose`` (3,) or listed
        in ``counts``. ``parameters`` (Q,): calibration of the detection models, see the class."""
        return ExpectedReads(*kernels.predicted(*self.arrays, counts.packed, pose, parameters))

    def probabilities(self, poses: Array, antenna: int) -> Array:
        """Return the probability (N, T) that one inventory round reads each of T tags, with the robot at each of
        ``poses`` (N, 3). False reads are included. ``antenna``: the index of the antenna."""
        poses, antennas = np.ascontiguousarray(poses, dtype=float), np.full(len(poses), antenna)
        return kernels.probabilities(self.packed, antennas, poses, self.tags.points, self.tags.normals)[0]
