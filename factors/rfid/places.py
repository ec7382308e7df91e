"""The likelihood of reads and misses for poses anywhere in a map: what :mod:`factors.rfid.anywhere` needs, made and kept."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from factors.rfid import anywhere, scattered
from factors.rfid.anywhere import Antennas, Heights, Listed, PlaceTables, TagSilence
from factors.rfid.counts import TagReadCounts
from factors.rfid.index import TagIndex
from factors.rfid.model import Packed, RfidModel
from factors.rfid.near import MapTags
from factors.rfid.scattered import Looked
from factors.rfid.tables import Tables, logs_of
from factors.se2 import Array, Integers

WIDE = 2.0  # times the square that an antenna reaches: poses that touch more are looked at one by one
PLACED = 25  # work of a pose, besides what it looks at
BY_ANTENNA = 7  # work of a tag that is looked at by one antenna alone, where there are no tables of places


def reach_of(packed: Packed) -> float:
    """How far [m] an antenna of a model, as it is adjusted, reaches from the robot's middle."""
    levers = np.hypot(packed.antennas[:, 0], packed.antennas[:, 1])
    return float(np.max(packed.reach[packed.which] + levers, initial=0.0))


def is_wide(poses: Array, reach: float) -> bool:
    """Whether poses (N, 3) are so far apart that most tags are within ``reach`` [m] of few of them."""
    reached = np.ptp(poses[:, :2], axis=0) + 2.0 * reach
    return bool(np.prod(reached) > WIDE * (2.0 * reach) ** 2)


def in_reach(points: Array, reach: float) -> float:
    """How many of the tags at ``points`` (T, 2) are within ``reach`` [m] of a pose among them, on average."""
    if not len(points):
        return 0.0
    area = float(np.prod(np.ptp(points, axis=0) + 2.0 * reach))
    return len(points) * min(1.0, math.pi * reach**2 / area)


@dataclass(frozen=True, eq=False)
class Places:
    """A map's tags by place, with the tables of a model. ``points`` (T, 3), ``normals`` (T, 2) and ``levels`` (A, T) are in the
    order of the ``index``. ``tables``: of places, None for models that have none."""

    antennas: Antennas
    tables: PlaceTables | None
    index: TagIndex
    points: Array
    normals: Array
    levels: Integers
    _last: dict[tuple[object, ...], TagSilence] = field(default_factory=dict)

    @classmethod
    def of(cls, model: RfidModel, packed: Packed, tables: Tables, of_map: MapTags, heights: Heights) -> Places:
        """For the tags of a map with their ``heights``, from the ``tables`` of the antennas. ``packed``: the model as it is
        adjusted."""
        logs = logs_of(packed)
        order = of_map.cells.order
        of_tags = np.ascontiguousarray(of_map.points[order]), np.ascontiguousarray(of_map.normals[order])
        antennas = Antennas(packed, tables, logs, reach_of(packed))
        found = anywhere.place_tables(model, antennas, heights)
        return cls(antennas, found, of_map.cells, *of_tags, np.ascontiguousarray(tables.level[:, order]))

    def work(self, looks: TagReadCounts) -> int:
        """How many tags are looked at for one pose, on average; one that was read counts as four."""
        near = in_reach(self.points[:, :2], self.antennas.reach)
        if self.tables is None:
            return PLACED + round(BY_ANTENNA * len(looks.antennas) * near)
        return PLACED + round(near) + 4 * int(np.count_nonzero(looks.hits.any(axis=0)))

    def log_likelihood(self, poses: Array, looks: TagReadCounts, tempering: float) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3)."""
        odds = looks.others if looks.tags is not None else float(np.sort(looks.odds)[len(looks.odds) // 2])
        number, rows = self._numbered(looks, odds)
        of_map = self.index, self.points
        if self.tables is None:
            missed = np.sum(looks.rounds * self.antennas.logs[self.antennas.packed.which[looks.antennas], 0, 1])
            states = number, looks.odds[rows], looks.elsewhere[rows], odds
            looked = Looked(looks.antennas, looks.rounds, np.ascontiguousarray(looks.hits[:, rows]), *states)
            out = np.full(len(poses), tempering * len(self.points) * float(missed))
            scattered.log_likelihood(poses, *of_map, self.normals, self.levels, self.antennas, looked, tempering, out)
            return out
        silent = self._silence(self.tables, looks, odds, tempering)
        listed = self._listed(self.tables, looks, number, rows, tempering)
        out = np.full(len(poses), tempering * len(self.points) * float(looks.rounds.sum()) * self.tables.none[1])
        levels = self.tables.level[self.index.order]
        anywhere.log_likelihood(poses, *of_map, levels, self.tables, silent, listed, tempering, out)
        return out

    def _silence(self, tables: PlaceTables, looks: TagReadCounts, odds: float, tempering: float) -> TagSilence:
        """What a silence tells, for the odds that most tags have; that of the last looks is kept."""
        key = (looks.antennas.tobytes(), looks.rounds.tobytes(), odds, tempering)
        if key not in self._last:
            self._last.clear()
            self._last[key] = anywhere.silence(tables, looks.antennas, looks.rounds, odds, tempering)
        return self._last[key]

    def _numbered(self, looks: TagReadCounts, odds: float) -> tuple[NDArray[np.int32], Integers]:
        """The tags that are not as most are: their number (T,) for each tag of the index, -1 for others, and their rows (W,) in the
        looks."""
        rows = np.arange(len(looks.odds))
        if looks.tags is None:
            rows = np.flatnonzero(looks.hits.any(axis=0) | (looks.odds != odds) | (looks.elsewhere != 0.0))
        number = np.full(len(self.points), -1, dtype=np.int32)
        number[looks.listed[rows]] = np.arange(len(rows))
        return number[self.index.order], rows

    def _listed(
        self, tables: PlaceTables, looks: TagReadCounts, number: NDArray[np.int32], rows: Integers, tempering: float
    ) -> Listed:
        which, antennas = np.nonzero(looks.hits[:, rows].T)
        first = np.searchsorted(which, np.arange(len(rows) + 1)).astype(np.int64)
        hits = looks.hits[:, rows].T[which, antennas]
        states = looks.odds[rows], looks.elsewhere[rows]
        far = anywhere.far_from(tables, first, hits, states, tempering)
        return Listed(number, *states, first, looks.antennas[antennas], hits, far)
