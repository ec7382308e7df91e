"""Reads and misses of the antennas along the reference.

Rounds of an antenna at nearly the same pose are merged into k reads of n rounds, because they are correlated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.fitting.posterior import by_block
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.smoothed import REFERENCE_GAP
from factorgraph_loc.text import listed
from factors.rfid.detection import TagArray
from factors.se2 import Array

CELL = (0.05, 0.05, 0.05, 1.0)  # m, m, rad, antennas; rounds in one cell are merged
MOST_ROUNDS = 20.0  # weight limit per pose; otherwise a robot at rest would outweigh its whole drive
MIN_ROUNDS = 100

Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Rounds:
    """K poses with antenna rounds, and T tags of the map that were read at least once in the log.

    ``t`` (K,) [s] and ``poses`` (K, 3) of the robot; ``antenna`` (K,): index in the rig; ``count`` (K,): weighted number of
    inventory rounds; ``hits`` (K, T): number of rounds that read each tag. ``tags``: as surveyed; ``names``: T EPCs.
    """

    log: str
    t: Array
    poses: Array
    antenna: Integers
    count: Array
    hits: Array
    tags: TagArray
    names: tuple[str, ...]

    def part(self, keep: NDArray[np.bool_] | Integers) -> Rounds:
        """The selected poses."""
        columns = ("t", "poses", "antenna", "count", "hits")
        return replace(self, **{name: getattr(self, name)[keep] for name in columns})


def rounds_of(log: Log, settings: RfidSettings, *, merged: bool = True) -> Rounds:
    """The rounds of a log within the reference, without unknown EPCs and antennas.

    ``merged``: merge rounds at nearly the same pose. The pose is that at the middle of the reads. InputError if there are too few
    rounds or read tags.
    """
    stream = log.streams["rfid"]
    assert isinstance(stream, RfidStream)
    assert log.reference is not None
    first, read = stream.first_rows, np.array([bool(epc) for epc in stream.epc], dtype=bool)
    t = stream.t[first] + log.rig.time_offset("rfid") - _middle(stream.age, stream.number, read, len(first))
    antennas = {name: i for i, name in enumerate(settings.all_antennas())}
    antenna = np.array([antennas.get(stream.antenna[i], -1) for i in first], dtype=np.int64)
    if np.all(antenna < 0):
        raise InputError(
            f"{log.name}: its antennas are {listed(dict.fromkeys(stream.antenna))}, those of the rig {listed(antennas)}: "
            "give them the same names in [rfid.antennas]"
        )
    tags = tag_map(log.world, SurveySettings(), set(stream.epc))
    order = np.argsort(t, kind="stable")
    poses = log.reference.at(t[order], max_gap=REFERENCE_GAP)
    good = np.isfinite(poses[:, 0]) & (antenna[order] >= 0)
    order, poses = order[good], poses[good]
    if len(order) < MIN_ROUNDS or len(tags.names) < 2:
        raise InputError(
            f"{log.name}: has {len(order)} inventory rounds of the rig's antennas within the reference, where "
            f"{len(tags.names)} tags of the map were read, expected {MIN_ROUNDS} rounds and 2 tags or more"
        )
    count, hits = np.ones(len(order)), stream.hits(tags.index)[order].astype(float)
    rounds = Rounds(log.name, t[order], poses, antenna[order], count, hits, tags.tags, tags.names)
    return _merged(rounds) if merged else rounds


def _middle(age: Array, inverse: Integers, read: NDArray[np.bool_], count: int) -> Array:
    """Time (count,) from the middle of each round to its end; a typical one for rounds without reads."""
    oldest, youngest = np.full(count, -np.inf), np.full(count, np.inf)
    np.maximum.at(oldest, inverse[read], age[read])
    np.minimum.at(youngest, inverse[read], age[read])
    known = np.isfinite(oldest)
    middle = np.zeros(count)
    middle[known] = 0.5 * (oldest[known] + youngest[known])
    middle[~known] = np.median(middle[known]) if np.any(known) else 0.0
    return middle


def cells(coordinates: Array, sizes: tuple[float, ...]) -> tuple[Integers, Integers]:
    """For rows of ``coordinates`` (M, D) in cells of ``sizes`` (D,): the first row in each cell, and the cell of each row."""
    keys = np.floor(coordinates / sizes).astype(np.int64)
    keys -= keys.min(axis=0)
    flat = np.ravel_multi_index(tuple(keys.T), tuple(keys.max(axis=0) + 1))
    _, first, cell = np.unique(flat, return_index=True, return_inverse=True)
    return first, cell


def overdispersion(
    hits: Array, count: Array, p: Array, antenna: Integers, tag: Integers, block: Integers
) -> tuple[float, float]:
    """The number of rounds with the information of an independent one, at least 1, and its standard error: by the scatter of each
    tag's reads by each antenna in blocks of time, ``hits`` (M,) of ``count`` rounds with the probability ``p``.

    Unlike the gradient by the pose, this scatter hardly depends on trajectories that were estimated from the same reads. It is a
    ratio of variances (McCullagh and Nelder, "Generalized linear models", 1989, section 4.5).
    """
    first, cell = cells(np.column_stack((block, tag, antenna)), (1.0, 1.0, 1.0))
    excess, variance = np.bincount(cell, hits - count * p), np.bincount(cell, count * p * (1.0 - p))
    observed, expected = by_block(np.column_stack((excess**2, variance)), block[first]).T
    total = max(float(expected.sum()), 1e-9)
    ratio = float(observed.sum()) / total
    error = float(np.sqrt(np.sum((observed - ratio * expected) ** 2))) / total
    return max(1.0, ratio), error


def _merged(rounds: Rounds) -> Rounds:
    """One round at the mean pose for all of an antenna in a cell of poses."""
    first, cell = cells(np.column_stack((rounds.poses, rounds.antenna)), CELL)
    size = np.bincount(cell).astype(float)
    weight = np.minimum(1.0, MOST_ROUNDS / size)
    poses, hits = by_block(rounds.poses, cell) / size[:, None], weight[:, None] * by_block(rounds.hits, cell)
    part = replace(rounds.part(first), poses=poses, hits=hits, count=weight * size)
    return part.part(np.argsort(part.t, kind="stable"))
