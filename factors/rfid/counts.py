"""Reads and misses of tags as counts."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.se2 import Array, Integers
from factors.se2_kernels import wrapped

# offsets, antennas, rounds, hits, odds and elsewhere; the places in the map that are listed, and the odds of the others
Seen = tuple[Array, Integers, Integers, Integers, Array, Array, Integers, float]


@dataclass(frozen=True, eq=False)
class TagReadCounts:
    """Read counts of tags by K antennas, each at its own pose.

    ``offsets`` (K, 3): the robot's pose at the measurement, in the frame of the likelihood's pose; ``antennas`` (K,): indices in
    the model; ``rounds`` (K,): inventory rounds. ``tags`` (C,): places in the map, ascending, of the tags that are listed; None,
    the default, if all of the map are. ``hits`` (K, C): number of rounds that read each of them; the others were not read.
    ``odds`` (C,): prior log-odds that each is dead or moved (:class:`~factors.rfid.tag_states.TagStates`), ``-inf`` for as
    surveyed, the default; ``others``: those of the tags that are not listed. ``elsewhere`` (C,): tempered log-likelihood of what
    was seen of the tag if so, relative to a silence out of reach; by default that of a dead tag: 0, or ``-inf`` if it was read.
    """

    offsets: Array
    antennas: NDArray[np.int64]
    rounds: NDArray[np.int64]
    hits: NDArray[np.int64]
    odds: Array = field(default_factory=lambda: np.empty(0))
    elsewhere: Array = field(default_factory=lambda: np.empty(0))
    tags: Integers | None = None
    others: float = -np.inf

    def __post_init__(self) -> None:
        if not len(self.odds):
            object.__setattr__(self, "odds", np.full(self.hits.shape[1], -np.inf))
        if not len(self.elsewhere):
            object.__setattr__(self, "elsewhere", np.where(self.hits.any(axis=0), -np.inf, 0.0))

    @cached_property
    def seen(self) -> Seen:
        """The counts for compiled code."""
        counts = self.offsets, self.antennas, self.rounds, self.hits
        return (*counts, self.odds, self.elsewhere, self.listed, self.others)

    @cached_property
    def listed(self) -> Integers:
        """Places (C,) in the map of the tags that are listed."""
        return np.arange(self.hits.shape[1]) if self.tags is None else self.tags

    @property
    def heard(self) -> Integers:
        """Places in the map of the tags that were read, ascending."""
        return np.asarray(self.listed[self.hits.any(axis=0)])

    def moved(self, offset: Array) -> TagReadCounts:
        """The counts relative to the pose that lies ``offset`` (3,) before theirs."""
        return replace(self, offsets=moved(offset, self.offsets))

    def listing(self, tags: Integers) -> TagReadCounts:
        """The same with ``tags`` listed, ascending, which are among them all that are listed now."""
        if self.tags is None or len(tags) == len(self.tags):
            return self
        hits, odds, elsewhere = listing(self.tags, self.hits, self.odds, self.elsewhere, self.others, tags)
        return replace(self, hits=hits, odds=odds, elsewhere=elsewhere, tags=tags)


def together(parts: list[TagReadCounts]) -> TagReadCounts:
    """Merge counts relative to one pose, in order of time; the odds are those of the first that lists a tag, what they tell of tags
    adds up."""
    if len(parts) == 1:
        return parts[0]
    tags = parts[0].tags
    if tags is not None:
        tags = reduce(union, [p.listed for p in parts])
        odds = np.full(len(tags), parts[0].others)
        for p in reversed(parts):
            odds[np.searchsorted(tags, p.listed)] = p.odds
        parts = [p.listing(tags) for p in parts]
    else:
        odds = parts[0].odds
    return TagReadCounts(
        np.concatenate([p.offsets for p in parts]),
        np.concatenate([p.antennas for p in parts]),
        np.concatenate([p.rounds for p in parts]),
        np.concatenate([p.hits for p in parts]),
        odds,
        np.sum([p.elsewhere for p in parts], axis=0),
        tags,
        parts[0].others,
    )


@compiled
def moved(offset: Array, offsets: Array) -> Array:
    """The poses (K, 3) ``offset`` (3,) composed with ``offsets`` (K, 3)."""
    c, s, out = math.cos(offset[2]), math.sin(offset[2]), np.empty_like(offsets)
    for k in range(len(offsets)):
        out[k, 0] = offset[0] + c * offsets[k, 0] - s * offsets[k, 1]
        out[k, 1] = offset[1] + s * offsets[k, 0] + c * offsets[k, 1]
        out[k, 2] = wrapped(offset[2] + offsets[k, 2])
    return out


@compiled
def union(some: Integers, others: Integers) -> Integers:
    """All numbers of either, which are ascending both."""
    out = np.empty(len(some) + len(others), np.int64)
    i = j = count = 0
    while i < len(some) or j < len(others):
        if j == len(others) or (i < len(some) and some[i] <= others[j]):
            out[count] = some[i]
            j += j < len(others) and some[i] == others[j]
            i += 1
        else:
            out[count] = others[j]
            j += 1
        count += 1
    return out[:count]


@compiled
def listing(
    listed: Integers, hits: Integers, odds: Array, elsewhere: Array, others: float, tags: Integers
) -> tuple[Integers, Array, Array]:
    """Hits, odds and elsewhere of ``tags``, of which not all are listed, nor all that are listed among them."""
    new_hits = np.zeros((len(hits), len(tags)), np.int64)
    new_odds, new_elsewhere = np.full(len(tags), others), np.zeros(len(tags))
    i = 0
    for u in range(len(tags)):
        while i < len(listed) and listed[i] < tags[u]:
            i += 1
        if i < len(listed) and listed[i] == tags[u]:
            for k in range(len(hits)):
                new_hits[k, u] = hits[k, i]
            new_odds[u], new_elsewhere[u] = odds[i], elsewhere[i]
    return new_hits, new_odds, new_elsewhere
