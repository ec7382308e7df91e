"""The likelihood of RFID reads and misses with a map of tags.

It is exact with derivatives for Gaussian states and graphs (:mod:`factors.rfid.kernels`), and from tables without derivatives for
particles. The log-likelihood is tempered: multiplied by an exponent below 1 for correlated reads. A tag that may be dead or moved
has a mixture likelihood (:mod:`factors.rfid.tag_states`).
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
from factors.rfid.parameters import adjusted
from factors.rfid.places import Places, RobotTables, antennas_of, in_reach, is_wide, robot_tables
from factors.rfid.tables import Tables, make_tables
from factors.se2 import Array, Integers


@dataclass(frozen=True, eq=False)
class TagArray:
    """T tags: ``points`` (T, 3) [m] in the world and ``facing`` (T,) [rad], NaN if unknown."""

    points: Array
    facing: Array

    @cached_property
    def normals(self) -> Array:
        """The facing directions (T, 2) of the tags, zero if unknown."""
        known = np.isfinite(self.facing)
        angle = np.where(known, self.facing, 0.0)
        return np.where(known[:, None], np.column_stack((np.cos(angle), np.sin(angle))), 0.0)


@dataclass(frozen=True, eq=False)
class TagReadCounts:
    """Read counts of tags by K antennas, each at its own pose.

    ``offsets`` (K, 3): the robot's pose at the measurement, in the frame of the likelihood's pose; ``twists`` (K, 3): its
    velocity [m/s, rad/s] there, 0 by default; ``antennas`` (K,): indices in the model; ``rounds`` (K,): inventory rounds.
    ``tags`` (C,): places in the map, ascending, of the tags that are listed; by default all of the map.
    ``hits`` (K, C): number of rounds that read each of them; the others were not read.
    ``odds`` (C,): prior log-odds that each is dead or moved (:class:`~factors.rfid.tag_states.TagStates`), ``-inf`` for as
    surveyed, the default; ``unlisted_odds``: those of the other tags. ``elsewhere`` (C,): tempered log-likelihood of a tag's reads
    and misses if it is dead or moved, relative to a silence out of reach; by default of a dead tag: 0, ``-inf`` if it was read.
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
        """The counts for compiled code."""
        counts = self.offsets, self.antennas, self.rounds, self.hits
        return (*counts, self.odds, self.elsewhere, self.tags, self.unlisted_odds, self.twists)

    @property
    def read_tags(self) -> Integers:
        """Places in the map of the tags that were read, ascending."""
        return np.asarray(self.tags[self.hits.any(axis=0)])

    def with_states(self, tags: Integers, odds: Array, elsewhere: Array) -> TagReadCounts:
        """The counts with ``tags`` (U,) listed too, which have these ``odds`` (U,) and ``elsewhere`` (U,)."""
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
        """The counts relative to the pose that lies ``offset`` (3,) before theirs."""
        return replace(self, offsets=moved(offset, self.offsets))


def merged(parts: list[TagReadCounts]) -> TagReadCounts:
    """Merge counts relative to one pose, in order of time. The odds are those of the first that lists a tag; ``elsewhere`` is the
    sum of all."""
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
    """Tempered likelihoods of N poses. ``nll`` (N,); ``gradient`` (N, 3) and ``information`` (N, 3, 3) by body-frame perturbation;
    ``expected`` (N,) and ``variance`` (N,): mean and variance of ``nll`` for a correct model and pose. The variance is proportional
    to the tempering, which accounts for correlated reads."""

    nll: Array
    gradient: Array
    information: Array
    expected: Array
    variance: Array

    @classmethod
    def of_signals(cls, nll: Array, gradient: Array, information: Array) -> Score:
        """The score of a likelihood whose expected value is not computed: every measurement counts as likely as expected."""
        return cls(nll, gradient, information, nll, np.zeros(len(nll)))


class ExpectedReads(NamedTuple):
    """Reads of C tags, by their places in the map, in K measurements: ``hits``, ``p``: probability of a read, and ``distance`` [m]
    from the antenna in the plane, (K, C) each."""

    tags: Integers
    hits: Integers
    p: Array
    distance: Array


@dataclass(frozen=True, eq=False)
class RfidLikelihood:
    """The likelihood of an antenna model with M detection models and A antennas, and a map of tags.

    ``parameters`` (Q,), Q = 2 M + A + 2: of models, mounting and clock (:mod:`factors.rfid.parameters`).
    """

    model: RfidModel
    tags: TagArray
    parameters: Array = field(init=False, repr=False)
    _unadjusted: RfidLikelihood = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", np.zeros(2 * len(self.model.models) + len(self.model.antennas) + 2))
        object.__setattr__(self, "_unadjusted", self)

    def adjusted(self, parameters: Array) -> RfidLikelihood:
        """The same with other parameters (Q,). ValueError if there is another number of them."""
        parameters, out = np.asarray(parameters, dtype=float), copy.copy(self)
        if parameters.shape != self.parameters.shape:
            raise ValueError(f"{parameters.shape} parameters of a likelihood, expected {self.parameters.shape}")
        out.__dict__.pop("packed", None)
        object.__setattr__(out, "parameters", parameters)
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

    @cached_property
    def packed(self) -> Packed:
        """The models with the parameters, for compiled code."""
        if self._unadjusted is self:
            return self.model.packed()
        return adjusted(self._unadjusted.packed, self.parameters)

    @cached_property
    def arrays(self) -> tuple[Packed, MapTags]:
        """The models without adjustment and the map, for compiled code."""
        return self._unadjusted.packed, self._unadjusted._map

    def joint_score(
        self, pose: Array, parameters: Array, counts: TagReadCounts, estimated: Sequence[int] | None = None
    ) -> Score:
        """Likelihood, gradient (1, 3 + P) and information (1, 3 + P, 3 + P) at one pose (3,), by its body-frame perturbation and
        those of the ``parameters`` (Q,) that are ``estimated`` (P,), by default all."""
        places = np.array(range(len(parameters)) if estimated is None else estimated, dtype=np.int64)
        pose, alpha = np.ascontiguousarray(pose, dtype=float), float(self.model.tempering)
        packed = *self.arrays, counts.packed
        nll, gradient, information, *moments = kernels.score(*packed, alpha, pose, parameters, places)
        expected, variance = np.array(moments)[:, None]
        return Score(np.array((nll,)), gradient[None], information[None], expected, variance)

    def score(self, poses: Array, counts: TagReadCounts) -> Score:
        """Likelihood, gradient and information at poses (N, 3)."""
        poses = np.ascontiguousarray(np.atleast_2d(poses), dtype=float)
        no_columns = np.full(len(self.parameters), -1, dtype=np.int64)
        alpha = float(self.model.tempering)
        return Score(*kernels.scores(self.packed, self.arrays[1], counts.packed, alpha, poses, no_columns))

    def displaced(
        self, poses: Array, counts: TagReadCounts, hypotheses: Array, margin: float, parameters: Array, odds: Array
    ) -> tuple[Integers, Array, NDArray[np.bool_]]:
        """The tags (U,) within a ``margin`` [m] of the reach from any of the poses (N, 3), or read, whose ``odds`` (T,) are not
        ``-inf``; the tempered log-likelihood (U, S) of the reads and misses of each for ``hypotheses`` (S, 4) of
        :mod:`factors.rfid.tag_states`, relative to a silence out of reach: the mean of the likelihood over the poses; and which
        of them were read. ``parameters``: (Q,)."""
        alpha = float(self.model.tempering)
        return tag_states.displaced(*self._tabled, counts.packed, poses, margin, odds, hypotheses, alpha, parameters)

    def log_likelihood(self, poses: Array, counts: TagReadCounts, parameters: Array | None = None) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3), from tables (:mod:`factors.rfid.weighing`, :mod:`factors.rfid.places`):
        for particles.

        ``parameters`` (N, Q): at each pose, by default its own; where time offsets differ, all measurements have
        the velocity of the first.
        """
        poses = np.ascontiguousarray(poses, dtype=float)
        if parameters is None and not (self.parameters.any() or counts.offsets.any()) and is_wide(poses, self.reach):
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
        """The mean number of tags, summed over antennas, that enter the likelihood of one pose if poses are far apart."""
        return self._unadjusted._places.work(counts.packed)

    @property
    def reach(self) -> float:
        """How far [m] an antenna reaches from the robot's middle."""
        return kernels.reach_of(self.packed, np.zeros((0, 3)))

    @cached_property
    def reached(self) -> float:
        """How many tags are in reach of a pose among them, on average."""
        return in_reach(self.tags.points[:, :2], self._unadjusted.reach)

    @cached_property
    def _places(self) -> Places:
        return Places.of(antennas_of(self.packed, self._tables), self._map, uses_facing=self.uses_facing)

    @property
    def uses_facing(self) -> bool:
        """Whether the facing of tags matters."""
        return any(self.model.models[a.model].uses_facing for a in self.model.antennas)

    def robot_tables(self, finest: int, facings: int) -> RobotTables:
        """Tables of the response by a tag's position in the robot frame (:func:`factors.rfid.places.robot_tables`)."""
        antennas = antennas_of(self.packed, self._unadjusted._tables)
        return robot_tables(antennas, self.tags.points[:, 2], finest, facings if self.uses_facing else 0)

    def by_tag(self, pose: Array, counts: TagReadCounts) -> tuple[Array, Array, Array]:
        """The contribution of each tag, all of the map being listed, at one pose (3,): tempered negative log-likelihood (T,),
        its gradient (T, 2) by the tag's position in the world, and information (T, 2, 2)."""
        arrays, alpha = counts.packed[:4], self.model.tempering
        pose = np.asarray(pose, dtype=float)
        nll, slope, curve = kernels.by_tag(self.packed, pose, self.tags.points, self.tags.normals, *arrays)
        return alpha * nll, alpha * slope[:, 3:], alpha * curve[:, 3:, 3:]

    def expected(self, pose: Array, counts: TagReadCounts, parameters: Array) -> ExpectedReads:
        """Observed and expected reads at a pose (3,) with ``parameters`` (Q,), of the tags that are in reach or listed."""
        return ExpectedReads(*kernels.predicted(*self.arrays, counts.packed, pose, parameters))

    def probabilities(self, poses: Array, antenna: int) -> Array:
        """Probability (N, T), floor included, that a round of an antenna reads each tag from poses (N, 3)."""
        poses, antennas = np.ascontiguousarray(poses, dtype=float), np.full(len(poses), antenna)
        return kernels.probabilities(self.packed, antennas, poses, self.tags.points, self.tags.normals)[0]
