"""The likelihood of RFID reads for poses that may be anywhere in a large map, as those of a search.

For each pose only the tags in its reach count, which a :class:`~factors.rfid.index.TagIndex` finds. Most of them were
not read. The log-likelihood of a miss is a function of the tag's position in the robot frame, the same for all tags of
one height. It is tabulated for all antennas together, as is what a read by each antenna adds, in the cells of
:mod:`factors.rfid.tables`. Models are evaluated antenna by antenna if they use the facing of tags, if they have no
tables of antennas (logistic ones), or if the tables of places would be too large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.rfid.index import MapTags, Seen, TagIndex, cells
from factors.rfid.kernels import FAST
from factors.rfid.model import LOGISTIC, Packed, RfidModel
from factors.rfid.tables import CELL, NO_MATTER, Array32, Tables, logs_of, row_of
from factors.rfid.weighing import mixed
from factors.se2 import Array, Integers

MOST = 1 << 25  # numbers in the tables; more have none
WIDE = 2.0  # times the square that an antenna reaches: poses that touch more are evaluated one by one
PLACED = 25  # work of a pose, besides that of its tags
BY_ANTENNA = 7  # work of a tag for one antenna, where there are no tables of places


class PlaceTables(NamedTuple):
    """Of H heights: ``gain`` (A, H, S, S), log q - log(1 - q) of each antenna for a tag at a position in the robot frame, and
    ``missed`` (A, H, S, S), log(1 - q) above that out of reach; ``level`` (T,): height of each tag. Without tables these are
    empty. ``none`` (A, 2): log q and log(1 - q) of each antenna out of reach."""

    gain: Array32
    missed: Array32
    level: Integers
    none: Array


class MissTable(NamedTuple):
    """Log-likelihood of a tag that nobody reads, by its position in the robot frame: ``surveyed`` (H, S, S), above that out of
    reach; ``folded`` (H, S, S): the same, tempered, of a tag that may be dead or moved; ``reach`` [m], beyond which it is 0."""

    surveyed: Array32
    folded: Array32
    reach: float


class Scan(NamedTuple):
    """``hits`` (K, W) in ``rounds`` (K,) of ``antennas`` (K,) of the W tags that are not as most are; ``number`` (T,): which of
    these a tag of the index is, -1 for others. Log-odds ``odds`` (W,) and ``elsewhere`` (W,) of those, and the odds of the
    ``others``, as in :mod:`factors.rfid.tag_states`."""

    antennas: Integers
    rounds: Integers
    hits: Integers
    number: NDArray[np.int32]
    odds: Array
    elsewhere: Array
    others: float


class Antennas(NamedTuple):
    """An adjusted model and its tables. ``logs`` (M, Z, 2): log q and log(1 - q) of each detection model for the logits of the
    tables; ``reach`` [m], from the robot's middle."""

    packed: Packed
    tables: Tables
    logs: Array32
    reach: float


def reach_of(packed: Packed) -> float:
    """How far [m] an antenna of an adjusted model reaches from the robot's middle."""
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
    """A map's tags by position, with the tables of a model. ``points`` (T, 3), ``normals`` (T, 2) and ``levels`` (A, T) are in the
    order of the ``index``."""

    antennas: Antennas
    tables: PlaceTables
    index: TagIndex
    points: Array
    normals: Array
    levels: Integers
    _last: dict[tuple[object, ...], MissTable] = field(default_factory=dict)

    @classmethod
    def of(cls, model: RfidModel, packed: Packed, tables: Tables, of_map: MapTags) -> Places:
        """For the tags of a map, from the ``tables`` of the antennas. ``packed``: the adjusted model."""
        order = of_map.cells.order
        of_tags = np.ascontiguousarray(of_map.points[order]), np.ascontiguousarray(of_map.normals[order])
        antennas = Antennas(packed, tables, logs_of(packed), reach_of(packed))
        made = place_tables(model, antennas, order)
        return cls(antennas, made, of_map.cells, *of_tags, np.ascontiguousarray(tables.level[:, order]))

    def work(self, seen: Seen) -> int:
        """How many tags count for one pose, on average; one that was read counts as four."""
        near = in_reach(self.points[:, :2], self.antennas.reach)
        _, antennas, _, hits, *_ = seen
        if not self.tables.gain.size:
            return PLACED + round(BY_ANTENNA * len(antennas) * near)
        return PLACED + round(near) + 4 * int(np.count_nonzero(hits.any(axis=0)))

    def log_likelihood(self, poses: Array, seen: Seen, tempering: float) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3)."""
        scan = self._scan(seen)
        missed = float(scan.rounds @ self.tables.none[scan.antennas, 1])
        out = np.full(len(poses), tempering * len(self.points) * missed)
        of_tags = self.points, self.normals, self.levels
        table = self._missed(scan, tempering)
        _log_likelihood(poses, self.index, *of_tags, self.antennas, self.tables, table, scan, tempering, out)
        return out

    def _missed(self, scan: Scan, tempering: float) -> MissTable:
        """The table of misses for the odds that most tags have; that of the last scan is kept."""
        key = (scan.antennas.tobytes(), scan.rounds.tobytes(), scan.others, tempering)
        if key not in self._last:
            self._last.clear()
            self._last[key] = miss_table(self.tables, scan, tempering, self.antennas.reach)
        return self._last[key]

    def _scan(self, seen: Seen) -> Scan:
        """The reads, with the tags listed that are not as most are."""
        _, antennas, rounds, hits, odds, elsewhere, listed, others = seen
        rows = np.arange(len(odds))
        if len(odds) == len(self.points) > 0:
            others = float(np.sort(odds)[len(odds) // 2])
            rows = np.flatnonzero(hits.any(axis=0) | (odds != others) | (elsewhere != 0.0))
        number = np.full(len(self.points), -1, dtype=np.int32)
        number[listed[rows]] = np.arange(len(rows))
        of_rows = number[self.index.order], odds[rows], elsewhere[rows]
        return Scan(antennas, rounds, np.ascontiguousarray(hits[:, rows]), *of_rows, others)


def place_tables(model: RfidModel, antennas: Antennas, order: Integers) -> PlaceTables:
    """The tables of places, from those of the antennas, for tags in this ``order``; empty where facings matter, for models that
    have none, and where they would be too large."""
    packed, tables, logs, reach = antennas
    used = [packed.kinds[a.model] for a in model.antennas]
    nothing, no_level = np.empty((0, 0, 0, 0), dtype=np.float32), np.empty(0, dtype=np.int64)
    without = PlaceTables(nothing, nothing, no_level, logs[packed.which, 0].astype(float))
    if not tables.level.size or LOGISTIC in used or tables.facings.max() > 1:
        return without
    columns, level = np.unique(tables.level.T, axis=0, return_inverse=True)
    half = math.ceil(reach / CELL)
    shape = (len(used), len(columns), 2 * half + 1, 2 * half + 1)
    if math.prod(shape) > MOST:
        return without
    gain, missed = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
    q = packed.false_read + packed.span * tables.sigmoids[0]
    none = np.tile(np.log(np.array((q, 1.0 - q))), (len(used), 1))
    _fill(packed, tables, logs, columns, half, none, gain, missed)
    return PlaceTables(gain, missed, level.reshape(-1).astype(np.int64)[order], none)


def miss_table(tables: PlaceTables, scan: Scan, tempering: float, reach: float) -> MissTable:
    """The table of misses of the antennas and rounds of a scan."""
    total: Array32 = np.zeros(tables.missed.shape[1:], dtype=np.float32)
    if not total.size:
        return MissTable(total, total, reach)
    for antenna, count in zip(scan.antennas.tolist(), scan.rounds.tolist(), strict=True):
        total += np.float32(count) * tables.missed[antenna]
    own: Array32 = np.float32(tempering) * total
    folded = own
    if scan.others > -np.inf:
        folded = (np.logaddexp(own, scan.others) - np.logaddexp(0.0, scan.others)).astype(np.float32)
    half = (total.shape[1] - 1) // 2
    relevant = np.argwhere((np.abs(own) > NO_MATTER).any(axis=0)) - half
    farthest = CELL * (float(np.max(np.hypot(*relevant.T), initial=0.0)) + 1.0)
    return MissTable(total, folded, min(farthest, reach))


@compiled(error_model="numpy", fastmath=FAST)
def _log_likelihood(
    poses: Array,
    index: TagIndex,
    points: Array,
    normals: Array,
    levels: Integers,
    model: Antennas,
    tables: PlaceTables,
    missed: MissTable,
    scan: Scan,
    tempering: float,
    out: Array,
) -> None:
    """Add to ``out`` (N,) the tempered log-likelihood, above that of misses out of reach, of poses (N, 3).

    ``points`` (T, 3), ``normals`` (T, 2) and ``levels`` (A, T): of tags in the order of the index.
    """
    far, tabled = _far(tables, scan, tempering), tables.gain.size > 0
    rows, base = (len(index.start) - 1) // index.columns, far.sum()
    reach2, missed2 = model.reach**2, missed.reach**2
    at = np.empty((len(scan.antennas), 4))
    for n in range(len(poses)):
        px, py, c, s = poses[n, 0], poses[n, 1], math.cos(poses[n, 2]), math.sin(poses[n, 2])
        if not tabled:
            _place(model.packed, scan.antennas, px, py, c, s, at)
        total = base
        first_x, last_x = cells(index, px - model.reach, px + model.reach, 0, index.columns)
        first_y, last_y = cells(index, py - model.reach, py + model.reach, 1, rows)
        for line in range(first_y, last_y + 1 if last_x >= first_x else first_y):
            begin, end = index.start[line * index.columns + first_x], index.start[line * index.columns + last_x + 1]
            for t in range(begin, end):
                ex, ey = points[t, 0] - px, points[t, 1] - py
                w = scan.number[t]
                if ex * ex + ey * ey >= (missed2 if w < 0 else reach2):
                    continue
                if tabled and w < 0:
                    h, i, j = _cell(tables, missed, t, c * ex + s * ey, c * ey - s * ex)
                    total += missed.folded[h, i, j]
                elif tabled:
                    h, i, j = _cell(tables, missed, t, c * ex + s * ey, c * ey - s * ex)
                    own = float(missed.surveyed[h, i, j])
                    for k in range(len(scan.antennas)):
                        if scan.hits[k, w] > 0:
                            own += scan.hits[k, w] * tables.gain[scan.antennas[k], h, i, j]
                    total += mixed(tempering * own, scan.odds[w], scan.elsewhere[w]) - far[w]
                else:
                    own = tempering * _of_tag(model, scan, at, points[t], normals[t], levels[:, t], w)
                    if w < 0:
                        total += mixed(own, scan.others, 0.0)
                    else:
                        total += mixed(own, scan.odds[w], scan.elsewhere[w]) - far[w]
        out[n] += total


@compiled(error_model="numpy", fastmath=FAST)
def _far(tables: PlaceTables, scan: Scan, tempering: float) -> Array:
    """The tempered log-likelihood (W,) of each listed tag out of reach, above that of misses."""
    out = np.empty(len(scan.odds))
    for w in range(len(out)):
        own = 0.0
        for k in range(len(scan.antennas)):
            none = tables.none[scan.antennas[k]]
            own += scan.hits[k, w] * (none[0] - none[1])
        out[w] = mixed(tempering * own, scan.odds[w], scan.elsewhere[w])
    return out


@compiled(inline="always")
def _cell(tables: PlaceTables, missed: MissTable, t: int, along: float, across: float) -> tuple[int, int, int]:
    """Height and cell in the tables of a tag at a position in the robot frame."""
    size = missed.surveyed.shape[1]
    middle, inverse = (size - 1) // 2 + 0.5, 1.0 / CELL
    i = min(max(int(along * inverse + middle), 0), size - 1)
    j = min(max(int(across * inverse + middle), 0), size - 1)
    return tables.level[t], i, j


@compiled(inline="always")
def _place(packed: Packed, antennas: Integers, px: float, py: float, c: float, s: float, at: Array) -> None:
    """Fill ``at`` (K, 4): position of each antenna, cosine and sine of its heading, for a robot at (px, py)."""
    for k in range(len(antennas)):
        a = packed.antennas[antennas[k]]
        at[k, 0], at[k, 1] = px + c * a[0] - s * a[1], py + s * a[0] + c * a[1]
        at[k, 2], at[k, 3] = c * a[3] - s * a[4], s * a[3] + c * a[4]


@compiled(inline="always")
def _of_tag(model: Antennas, scan: Scan, at: Array, point: Array, normal: Array, levels: Integers, w: int) -> float:
    """The log-likelihood of one tag as surveyed, above that of misses out of reach, antenna by antenna."""
    packed, own = model.packed, 0.0
    for k in range(len(scan.antennas)):
        antenna = scan.antennas[k]
        m = packed.which[antenna]
        x, y = point[0] - at[k, 0], point[1] - at[k, 1]
        along, across = at[k, 2] * x + at[k, 3] * y, at[k, 2] * y - at[k, 3] * x
        row = 0
        if along * along + across * across < packed.reach[m] ** 2:
            facing = -(normal[0] * x + normal[1] * y) / math.sqrt(x * x + y * y + 1e-9)
            unit = 1.0 / packed.scale[m]
            row = row_of(packed, model.tables, antenna, levels[antenna], unit * along, unit * across, point[2], facing)
        if row == 0 and w < 0:
            continue
        log_p = np.float64(model.logs[m, row, 1])
        own += scan.rounds[k] * (log_p - np.float64(model.logs[m, 0, 1]))
        if w >= 0:
            own += scan.hits[k, w] * (np.float64(model.logs[m, row, 0]) - log_p)
    return own


@compiled
def _fill(
    packed: Packed,
    tables: Tables,
    logs: Array32,
    columns: Integers,
    half: int,
    none: Array,
    gain: Array32,
    missed: Array32,
) -> None:
    """Fill the tables of places from those of the antennas; ``columns`` (H, A): table of each height and antenna."""
    for a in range(len(gain)):
        at, m = packed.antennas[a], packed.which[a]
        unit = 1.0 / packed.scale[m]
        for h in range(gain.shape[1]):
            table = columns[h, a]
            to_edge = tables.half[table]
            size = 2 * to_edge + 1
            for i in range(2 * half + 1):
                for j in range(2 * half + 1):
                    ex, ey = (i - half) * CELL - at[0], (j - half) * CELL - at[1]
                    along = math.floor(unit * (at[3] * ex + at[4] * ey) / CELL + 0.5) + to_edge
                    across = math.floor(unit * (at[3] * ey - at[4] * ex) / CELL + 0.5) + to_edge
                    log_q, log_p = none[a]
                    if 0 <= along < size and 0 <= across < size:
                        row = tables.rows[tables.start[table] + along * size + across]
                        log_q, log_p = logs[m, row, 0], logs[m, row, 1]
                    gain[a, h, i, j] = log_q - log_p
                    missed[a, h, i, j] = log_p - none[a, 1]
