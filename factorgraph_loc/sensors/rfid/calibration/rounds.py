"""Data for the calibration of RFID: the rounds of each antenna along the reference of a log, with reads and misses.

Rounds of an antenna at nearly the same pose are correlated. They are merged into one row with the numbers of reads and
of rounds.
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

CELL = (0.05, 0.05, 0.05, 1.0)  # m, m, rad, antenna index; size of the cells for the merging of rounds
MOST_ROUNDS = 20.0  # maximum number of rounds that a pose counts, so that a robot at rest does not dominate the data
MIN_ROUNDS = 100

Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Rounds:
    """Inventory rounds of a log at K robot poses, and the T tags of the map that are read at least once.

    ``log``: the name of the log. ``t`` (K,): times [s]. ``poses`` (K, 3): robot poses. ``antenna`` (K,): the antenna of
    the rounds, as index in the rig. ``count`` (K,): the number of rounds, reduced if many rounds are merged. ``hits``
    (K, T): the number of rounds that read each tag, reduced by the same factor. ``tags``: positions and facings in the
    survey frame. ``names``: T EPCs.
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
        """Return a copy with only the selected poses. ``keep``: a mask (K,) or the indices of the poses."""
        columns = ("t", "poses", "antenna", "count", "hits")
        return replace(self, **{name: getattr(self, name)[keep] for name in columns})


def rounds_of(log: Log, settings: RfidSettings, *, merged: bool = True) -> Rounds:
    """Return the inventory rounds of a log at reference poses. Tags that are not in the map, and rounds of antennas
    that are not in the rig, are omitted.

    ``merged``: True to merge rounds at nearly equal poses. The time of a round is the middle of its reads. Raises
    InputError if the log has too few rounds, or reads of too few tags.
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
            f"{log.name}: the log has the antennas {listed(dict.fromkeys(stream.antenna))}, the rig has {listed(antennas)}: "
            "use the names of the log in [rfid.antennas]"
        )
    tags = tag_map(log.world, SurveySettings(), set(stream.epc))
    order = np.argsort(t, kind="stable")
    poses = log.reference.at(t[order], max_gap=REFERENCE_GAP)
    good = np.isfinite(poses[:, 0]) & (antenna[order] >= 0)
    order, poses = order[good], poses[good]
    if len(order) < MIN_ROUNDS or len(tags.names) < 2:
        raise InputError(
            f"{log.name}: has {len(order)} inventory rounds of the rig's antennas within the reference, and reads of "
            f"{len(tags.names)} tags of the map, expected at least {MIN_ROUNDS} rounds and 2 tags"
        )
    count, hits = np.ones(len(order)), stream.hits(tags.index)[order].astype(float)
    rounds = Rounds(log.name, t[order], poses, antenna[order], count, hits, tags.tags, tags.names)
    return _merged(rounds) if merged else rounds


def _middle(age: Array, inverse: Integers, read: NDArray[np.bool_], count: int) -> Array:
    """Return the age (R,) [s] of the middle of the reads of R = ``count`` rounds, relative to the end of each round. A
    round without reads gets the median age. ``age`` (N,): time [s] from each row to the end of its round. ``inverse``
    (N,): the round index of each row. ``read`` (N,): True for rows with a read."""
    oldest, youngest = np.full(count, -np.inf), np.full(count, np.inf)
    np.maximum.at(oldest, inverse[read], age[read])
    np.minimum.at(youngest, inverse[read], age[read])
    known = np.isfinite(oldest)
    middle = np.zeros(count)
    middle[known] = 0.5 * (oldest[known] + youngest[known])
    middle[~known] = np.median(middle[known]) if np.any(known) else 0.0
    return middle


def cells(coordinates: Array, sizes: tuple[float, ...]) -> tuple[Integers, Integers]:
    """Return the index (C,) of the first point in each of C occupied grid cells, and the cell (M,) of each point. Cells
    are numbered from 0 to C - 1. ``coordinates`` (M, D): the points. ``sizes`` (D,): the size of a cell."""
    keys = np.floor(coordinates / sizes).astype(np.int64)
    keys -= keys.min(axis=0)
    flat = np.ravel_multi_index(tuple(keys.T), tuple(keys.max(axis=0) + 1))
    _, first, cell = np.unique(flat, return_index=True, return_inverse=True)
    return first, cell


def overdispersion(
    hits: Array, count: Array, p: Array, antenna: Integers, tag: Integers, block: Integers
) -> tuple[float, float]:
    """Return the overdispersion of reads, at least 1, and its standard error.

    The number of reads of a tag by an antenna in a time block has a variance. The overdispersion is this variance
    divided by its value for independent reads (McCullagh and Nelder, "Generalized linear models", 1989, section 4.5).
    If it is n, n correlated rounds have as much information as one independent round. ``hits``, ``count`` (M,): numbers
    of reads and of rounds. ``p`` (M,): predicted probability of a read in one round. ``antenna``, ``tag``, ``block``
    (M,): indices of the antenna, the tag and the time block.
    """
    first, cell = cells(np.column_stack((block, tag, antenna)), (1.0, 1.0, 1.0))
    excess, variance = np.bincount(cell, hits - count * p), np.bincount(cell, count * p * (1.0 - p))
    observed, expected = by_block(np.column_stack((excess**2, variance)), block[first]).T
    total = max(float(expected.sum()), 1e-9)
    ratio = float(observed.sum()) / total
    error = float(np.sqrt(np.sum((observed - ratio * expected) ** 2))) / total
    return max(1.0, ratio), error


def _merged(rounds: Rounds) -> Rounds:
    """Return ``rounds`` with those of the same antenna at nearly equal poses merged at their mean pose."""
    first, cell = cells(np.column_stack((rounds.poses, rounds.antenna)), CELL)
    size = np.bincount(cell).astype(float)
    weight = np.minimum(1.0, MOST_ROUNDS / size)
    poses, hits = by_block(rounds.poses, cell) / size[:, None], weight[:, None] * by_block(rounds.hits, cell)
    part = replace(rounds.part(first), poses=poses, hits=hits, count=weight * size)
    return part.part(np.argsort(part.t, kind="stable"))
