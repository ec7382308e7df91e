"""The likelihood of reads and misses for poses anywhere in a map: what :mod:`factors.rfid.anywhere` needs, made and kept."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from factors.rfid import anywhere
from factors.rfid.anywhere import Listed, PlaceTables, TagSilence
from factors.rfid.counts import TagReadCounts
from factors.rfid.index import TagIndex, tag_index
from factors.rfid.model import Packed, RfidModel
from factors.rfid.tables import Tables
from factors.se2 import Array, Integers

WIDE = 2.0  # times the square that an antenna reaches: poses that touch more are looked at one by one


def in_reach(points: Array, reach: float) -> float:
    """How many of the tags at ``points`` (T, 2) are within ``reach`` [m] of a pose among them, on average."""
    if not len(points):
        return 0.0
    area = float(np.prod(np.ptp(points, axis=0) + 2.0 * reach))
    return len(points) * min(1.0, math.pi * reach**2 / area)


@dataclass(frozen=True, eq=False)
class Places:
    """A map's tags by place, with the tables of a model whose parameters are as in the rig. ``points`` (T, 2) and ``levels`` (T,)
    are in the order of the ``index``."""

    tables: PlaceTables
    tempering: float
    index: TagIndex
    points: Array
    levels: Integers
    _last: dict[tuple[object, ...], TagSilence] = field(default_factory=dict)

    @classmethod
    def of(cls, model: RfidModel, packed: Packed, antennas: Tables, points: Array) -> Places | None:
        """For tags at ``points`` (T, 3), from the tables of ``antennas``; None where there are none of places."""
        tables = anywhere.place_tables(model, packed, antennas)
        if tables is None:
            return None
        found = tag_index(points)
        ordered = np.ascontiguousarray(points[found.order, :2])
        return cls(tables, model.tempering, found, ordered, tables.level[found.order])

    def is_wide(self, poses: Array) -> bool:
        """Whether poses (N, 3) are so far apart that most tags are in reach of few of them."""
        reached = np.ptp(poses[:, :2], axis=0) + 2.0 * self.tables.reach
        return bool(np.prod(reached) > WIDE * (2.0 * self.tables.reach) ** 2)

    def work(self, looks: TagReadCounts) -> int:
        """How many tags are looked at for one pose, on average; one that was read counts as four."""
        return round(in_reach(self.points, self.tables.reach)) + 4 * int(np.count_nonzero(looks.hits.any(axis=0)))

    def log_likelihood(self, poses: Array, looks: TagReadCounts) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3)."""
        silent = self._silence(looks)
        listed = self._listed(looks, silent.odds)
        none = self.tempering * len(self.points) * float(looks.rounds.sum()) * self.tables.none[1]
        out = np.full(len(poses), none)
        of_map = self.index, self.points, self.levels
        anywhere.log_likelihood(poses, *of_map, self.tables, silent, listed, self.tempering, out)
        return out

    def _silence(self, looks: TagReadCounts) -> TagSilence:
        """What a silence tells, for the odds that most tags have; that of the last looks is kept."""
        odds = looks.others if looks.tags is not None else float(np.sort(looks.odds)[len(looks.odds) // 2])
        key = (looks.antennas.tobytes(), looks.rounds.tobytes(), odds)
        if key not in self._last:
            self._last.clear()
            self._last[key] = anywhere.silence(self.tables, looks.antennas, looks.rounds, odds, self.tempering)
        return self._last[key]

    def _listed(self, looks: TagReadCounts, odds: float) -> Listed:
        rows = np.arange(len(looks.odds))
        if looks.tags is None:
            rows = np.flatnonzero(looks.hits.any(axis=0) | (looks.odds != odds) | (looks.elsewhere != 0.0))
        number = np.full(len(self.points), -1, dtype=np.int32)
        number[looks.listed[rows]] = np.arange(len(rows))
        which, antennas = np.nonzero(looks.hits[:, rows].T)
        first = np.searchsorted(which, np.arange(len(rows) + 1)).astype(np.int64)
        hits = looks.hits[:, rows].T[which, antennas]
        states = looks.odds[rows], looks.elsewhere[rows]
        far = anywhere.far_from(self.tables, first, hits, states, self.tempering)
        return Listed(number[self.index.order], *states, first, looks.antennas[antennas], hits, far)
