"""Likelihood tables by the tag's position in the robot frame, and the likelihood of reads at poses anywhere in a large map.

All antennas of a robot measure from one robot pose. Their responses to a tag are therefore functions of the tag's
position in the robot frame, and equal for all tags of one height. A global search for the pose uses these tables.
Planning uses tables with larger cells.

For each pose, a :class:`~factors.rfid.index.TagIndex` finds the tags in reach. Most of these were not read, so one
table has the log-likelihood that all antennas together miss a tag. If a model depends on the facing of tags, a search
evaluates each antenna separately instead, because close to an antenna the facing changes within a cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.rfid.index import Counts, MapTags, TagIndex, cells
from factors.rfid.kernels import FAST
from factors.rfid.model import LOGISTIC, Packed
from factors.rfid.mounting import reach_of
from factors.rfid.tables import CELL, LEVEL, NO_MATTER, Array32, Tables, logs_of, row_of
from factors.rfid.weighing import LEAST, mixed
from factors.se2 import Array, Integers

MOST = 1 << 25  # maximum number of elements of a table; cells are made larger if necessary
# Poses are far apart if the area within their reach exceeds this multiple of the area within reach of one pose.
WIDE = 2.0
# Computing times, relative to reading a table for one tag: of a pose, and of a tag and antenna if there is no table.
PLACED = 25
BY_ANTENNA = 7


class RobotTables(NamedTuple):
    """The responses of A antennas to a tag, by the tag's position in the robot frame.

    A table has S x S cells of ``cell`` [m], for each of H heights and each of F directions of the tag's front. The last
    of the F tables is for tags with an unknown or irrelevant front. q is the read probability of one round.
    ``gain`` (A, H, F, S, S): log q - log(1 - q).
    ``missed`` (A, H, F, S, S): log(1 - q) minus its value out of reach.
    ``level`` (T,): the index of each tag's height. ``none`` (A, 2): log q and log(1 - q) out of reach.
    """

    gain: Array32
    missed: Array32
    level: Integers
    none: Array
    cell: float


class MissTable(NamedTuple):
    """The log-likelihood that no antenna reads a tag in a scan (K measurements), by the tag's position in the robot
    frame. It is relative to the log-likelihood of a tag out of reach.

    ``surveyed`` (H, S, S): untempered values of a tag at one of H heights that is as in the map.
    ``folded`` (H, S, S): tempered values of a tag that may be weak, moved or dead.
    ``cell`` [m]: the size of a cell. ``reach`` [m]: the distance beyond which both are zero.
    """

    surveyed: Array32
    folded: Array32
    cell: float
    reach: float


class Scan(NamedTuple):
    """The reads for one evaluation of the likelihood. W tags are listed: they were read or have unusual odds.

    ``antennas`` (K,), ``rounds`` (K,): antenna and number of rounds of each measurement. ``hits`` (K, W): the number of
    reads of each listed tag. ``number`` (T,): for each tag of the map, in the order of the spatial index, its index
    among the listed tags, or -1. ``odds`` (W,): the prior log-odds that a listed tag is weak, moved or dead.
    ``elsewhere`` (W,): the log-likelihood of its reads if so. ``unlisted_odds``: the odds of all unlisted tags.
    """

    antennas: Integers
    rounds: Integers
    hits: Integers
    number: NDArray[np.int32]
    odds: Array
    elsewhere: Array
    unlisted_odds: float


class Antennas(NamedTuple):
    """The detection models of all antennas, and their tables. ``logs`` (M, Z, 2): the logarithms of read and miss
    probability of M models, at the Z logits of the tables. ``reach`` [m]: the largest distance from the robot's origin
    at which a tag can be read."""

    packed: Packed
    tables: Tables
    logs: Array32
    reach: float


def antennas_of(packed: Packed, tables: Tables) -> Antennas:
    """Return the detection models ``packed`` with their ``tables``. The fields ``logs`` and ``reach`` are computed."""
    return Antennas(packed, tables, logs_of(packed), reach_of(packed, np.zeros((0, 3))))


def is_wide(poses: Array, reach: float) -> bool:
    """True if the poses (N, 3) are so far apart that most tags are within ``reach`` [m] of only a few of them."""
    reached = np.ptp(poses[:, :2], axis=0) + 2.0 * reach
    return bool(np.prod(reached) > WIDE * (2.0 * reach) ** 2)


def in_reach(points: Array, reach: float) -> float:
    """Return the mean number of ``points`` (T, 2) within ``reach`` [m] of a random point in their bounding box."""
    if not len(points):
        return 0.0
    area = float(np.prod(np.ptp(points, axis=0) + 2.0 * reach))
    return len(points) * min(1.0, math.pi * reach**2 / area)


def robot_tables(antennas: Antennas, heights: Array, finest: int = 1, facings: int = 0) -> RobotTables:
    """Return tables of the read probability by the tag's position in the robot frame.

    ``heights`` (T,) [m]: heights of the tags. ``finest``: the size of cells and of height steps, as a multiple of their
    size in the tables of ``antennas``. It is increased if the tables would be too large. ``facings``: number of
    directions of the tag's front with a table. One more table is for tags with an unknown or irrelevant front.
    """
    scale, size, (packed, tables, logs, reach) = finest, MOST + 1, antennas
    while size > MOST:
        steps = np.rint(heights / (scale * LEVEL)).astype(np.int64)
        _, first, level = np.unique(steps, return_index=True, return_inverse=True)
        edge = math.ceil(reach / (scale * CELL))
        shape = (len(packed.antennas), len(first), facings + 1, 2 * edge + 1, 2 * edge + 1)
        size, cell, scale = math.prod(shape), scale * CELL, scale + 1
    gain, missed = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
    q = np.clip(packed.false_read + packed.span * packed.rate[packed.which] * tables.sigmoids[0], LEAST, 1.0 - LEAST)
    none = np.log(np.column_stack((q, 1.0 - q)))
    _fill(packed, tables, logs, tables.level[:, first], heights[first], cell, none, gain, missed)
    return RobotTables(gain, missed, level.reshape(-1).astype(np.int64), none, cell)


def miss_table(tables: RobotTables, scan: Scan, tempering: float, reach: float) -> MissTable:
    """Return the log-likelihood that the scan did not read a tag, tabulated over the tag's position in the robot frame.
    ``tables``: read probabilities. ``tempering``: exponent of the likelihood. ``reach`` [m]: the largest distance."""
    total: Array32 = np.zeros((tables.missed.shape[1], *tables.missed.shape[3:]), dtype=np.float32)
    if not total.size:
        return MissTable(total, total, tables.cell, reach)
    for antenna, count in zip(scan.antennas.tolist(), scan.rounds.tolist(), strict=True):
        total += np.float32(count) * tables.missed[antenna, :, 0]
    own: Array32 = np.float32(tempering) * total
    folded = own
    if scan.unlisted_odds > -np.inf:
        folded = (np.logaddexp(own, scan.unlisted_odds) - np.logaddexp(0.0, scan.unlisted_odds)).astype(np.float32)
    relevant = np.argwhere((np.abs(own) > NO_MATTER).any(axis=0)) - total.shape[1] // 2
    farthest = tables.cell * (float(np.max(np.hypot(*relevant.T), initial=0.0)) + 1.0)
    return MissTable(total, folded, tables.cell, min(farthest, reach))


@dataclass(frozen=True, eq=False)
class Places:
    """The likelihood of RFID read counts at poses anywhere in a map.

    ``antennas``: the model and its tables. ``tables``: the tables by position in the robot frame, empty if the model
    depends on the direction of tags' fronts. ``index``: the spatial index of the map's tags. The other fields are in
    the order of the index. ``points`` (T, 3): positions. ``normals`` (T, 2): unit vectors of the tags' fronts.
    ``levels`` (A, T): for each antenna and tag, the index of its table in ``antennas``.
    """

    antennas: Antennas
    tables: RobotTables
    index: TagIndex
    points: Array
    normals: Array
    levels: Integers
    _last: dict[tuple[object, ...], MissTable] = field(default_factory=dict)

    @classmethod
    def of(cls, antennas: Antennas, of_map: MapTags, *, uses_facing: bool) -> Places:
        """Return the likelihood for tags of a map. ``uses_facing``: True if the model depends on the tags' fronts."""
        order = of_map.cells.order
        points, normals = np.ascontiguousarray(of_map.points[order]), np.ascontiguousarray(of_map.normals[order])
        tables = robot_tables(antennas, points[: 0 if uses_facing else len(points), 2])
        return cls(
            antennas, tables, of_map.cells, points, normals, np.ascontiguousarray(antennas.tables.level[:, order])
        )

    def work(self, counts: Counts) -> int:
        """Return the approximate computing time for ``counts`` at one pose, in evaluations of one unread tag."""
        near = in_reach(self.points[:, :2], self.antennas.reach)
        _, antennas, _, hits, *_ = counts
        if not self.tables.gain.size:
            return PLACED + round(BY_ANTENNA * len(antennas) * near)
        return PLACED + round(near) + 4 * int(np.count_nonzero(hits.any(axis=0)))

    def log_likelihood(self, poses: Array, counts: Counts, tempering: float) -> Array:
        """Return the tempered log-likelihood (N,) of read ``counts`` at poses (N, 3). ``tempering``: its exponent."""
        scan = self._scan(counts)
        missed = float(scan.rounds @ self.tables.none[scan.antennas, 1])
        out = np.full(len(poses), tempering * len(self.points) * missed)
        of_tags, table = (self.points, self.normals, self.levels), self._missed(scan, tempering)
        _log_likelihood(poses, self.index, *of_tags, self.antennas, self.tables, table, scan, tempering, out)
        return out

    def _missed(self, scan: Scan, tempering: float) -> MissTable:
        """Return the table of misses for tags that are not listed in the scan. It is cached for similar scans."""
        key = (scan.antennas.tobytes(), scan.rounds.tobytes(), scan.unlisted_odds, tempering)
        if key not in self._last:
            self._last.clear()
            self._last[key] = miss_table(self.tables, scan, tempering, self.antennas.reach)
        return self._last[key]

    def _scan(self, counts: Counts) -> Scan:
        """Return counts as a :class:`Scan` that lists the tags that were read or have other odds than most tags."""
        _, antennas, rounds, hits, odds, elsewhere, listed, unlisted_odds, _ = counts
        rows = np.arange(len(odds))
        if len(odds) == len(self.points) > 0:
            unlisted_odds = float(np.sort(odds)[len(odds) // 2])
            rows = np.flatnonzero(hits.any(axis=0) | (odds != unlisted_odds) | (elsewhere != 0.0))
        number = np.full(len(self.points), -1, dtype=np.int32)
        number[listed[rows]] = np.arange(len(rows))
        of_rows = number[self.index.order], odds[rows], elsewhere[rows]
        return Scan(antennas, rounds, np.ascontiguousarray(hits[:, rows]), *of_rows, unlisted_odds)


@compiled(error_model="numpy", fastmath=FAST)
def _log_likelihood(
    poses: Array,
    index: TagIndex,
    points: Array,
    normals: Array,
    levels: Integers,
    model: Antennas,
    tables: RobotTables,
    missed: MissTable,
    scan: Scan,
    tempering: float,
    out: Array,
) -> None:
    """Add the tempered log-likelihood of poses (N, 3), relative to poses without tags in reach, to ``out`` (N,).

    ``points`` (T, 3), ``normals`` (T, 2), ``levels`` (A, T): fields of :class:`Places`, like ``index`` and ``tables``.
    ``model``: the field ``antennas``. ``missed``: the table of misses. ``scan``: the reads.
    """
    far, tabled, reach = _far(tables, scan, tempering), tables.gain.size > 0, model.reach
    rows, base, size = (len(index.start) - 1) // index.columns, far.sum(), missed.surveyed.shape[1]
    reach2, missed2, middle, inverse = reach**2, missed.reach**2, size // 2 + 0.5, 1.0 / missed.cell
    for n in range(len(poses)):
        px, py, c, s = poses[n, 0], poses[n, 1], math.cos(poses[n, 2]), math.sin(poses[n, 2])
        total = base
        first_x, last_x = cells(index, px - reach, px + reach, 0, index.columns)
        first_y, last_y = cells(index, py - reach, py + reach, 1, rows)
        for line in range(first_y, last_y + 1 if last_x >= first_x else first_y):
            begin, end = index.start[line * index.columns + first_x], index.start[line * index.columns + last_x + 1]
            for t in range(begin, end):
                ex, ey = points[t, 0] - px, points[t, 1] - py
                w = scan.number[t]
                if ex * ex + ey * ey >= (missed2 if w < 0 else reach2):
                    continue
                x, y = c * ex + s * ey, c * ey - s * ex
                if tabled:
                    h = tables.level[t]
                    i = min(max(int(x * inverse + middle), 0), size - 1)
                    j = min(max(int(y * inverse + middle), 0), size - 1)
                    if w < 0:
                        total += missed.folded[h, i, j]
                        continue
                    own = float(missed.surveyed[h, i, j])
                    for k in range(len(scan.antennas)):
                        if scan.hits[k, w] > 0:
                            own += scan.hits[k, w] * tables.gain[scan.antennas[k], h, 0, i, j]
                else:
                    nx, ny = c * normals[t, 0] + s * normals[t, 1], c * normals[t, 1] - s * normals[t, 0]
                    own = _of_tag(model, scan, x, y, points[t, 2], nx, ny, levels[:, t], w)
                    if w < 0:
                        total += mixed(tempering * own, scan.unlisted_odds, 0.0)
                        continue
                total += mixed(tempering * own, scan.odds[w], scan.elsewhere[w]) - far[w]
        out[n] += total


@compiled(inline="always")
def _of_tag(
    model: Antennas, scan: Scan, x: float, y: float, height: float, nx: float, ny: float, levels: Integers, w: int
) -> float:
    """Return the untempered log-likelihood of one tag that is as in the map, minus that of a tag never read out of
    reach.

    ``x``, ``y``, ``height``, ``nx``, ``ny``: position and front of the tag in the robot frame. ``levels`` (A,): the
    numbers of the tag's tables. ``w``: the tag's number among the listed tags of the scan, or -1 if it is not listed.
    """
    packed, own = model.packed, 0.0
    for k in range(len(scan.antennas)):
        antenna = scan.antennas[k]
        m, at = packed.which[antenna], packed.antennas[antenna]
        ex, ey, unit, row = x - at[0], y - at[1], 1.0 / packed.scale[m], 0
        along, across, squared = at[3] * ex + at[4] * ey, at[3] * ey - at[4] * ex, ex * ex + ey * ey
        if squared < packed.reach[m] ** 2:
            facing = -(nx * ex + ny * ey) / math.sqrt(squared + 1e-9)
            row = row_of(packed, model.tables, antenna, levels[antenna], unit * along, unit * across, height, facing)
        if row == 0 and w < 0:
            continue
        log_p = np.float64(model.logs[m, row, 1])
        own += scan.rounds[k] * (log_p - np.float64(model.logs[m, 0, 1]))
        if w >= 0:
            own += scan.hits[k, w] * (np.float64(model.logs[m, row, 0]) - log_p)
    return own


@compiled(error_model="numpy", fastmath=FAST)
def _far(tables: RobotTables, scan: Scan, tempering: float) -> Array:
    """Return the tempered log-likelihood (W,) of the reads of each listed tag of the scan if it is out of reach. It is
    relative to the log-likelihood of no reads."""
    out = np.empty(len(scan.odds))
    for w in range(len(out)):
        own = 0.0
        for k in range(len(scan.antennas)):
            none = tables.none[scan.antennas[k]]
            own += scan.hits[k, w] * (none[0] - none[1])
        out[w] = mixed(tempering * own, scan.odds[w], scan.elsewhere[w])
    return out


@compiled(error_model="numpy", fastmath=FAST)
def _fill(
    packed: Packed,
    tables: Tables,
    logs: Array32,
    levels: Integers,
    heights: Array,
    cell: float,
    none: Array,
    gain: Array32,
    missed: Array32,
) -> None:
    """Write ``gain`` and ``missed`` of :class:`RobotTables`, computed from the ``tables`` of the antennas. ``levels``
    (A, H): the index of the table of each antenna and height. ``heights`` (H,) [m]: heights of tags. ``cell`` [m]: size
    of a cell."""
    layers, half = gain.shape[2], gain.shape[3] // 2
    for a in range(len(gain)):
        at, m = packed.antennas[a], packed.which[a]
        unit, reach2, is_logistic = 1.0 / packed.scale[m], packed.reach[m] ** 2, packed.kinds[m] == LOGISTIC
        by_reach = is_logistic or layers > 1  # False if the whole square of a table is in reach
        for h in range(len(heights)):
            level, edge = levels[a, h], 0.0
            if not is_logistic:
                edge = (tables.half[level] + 0.5) * CELL
            for f in range(layers):
                angle = 2.0 * math.pi * f / max(layers - 1, 1)
                nx, ny = (math.cos(angle), math.sin(angle)) if f < layers - 1 else (0.0, 0.0)
                for i in range(2 * half + 1):
                    for j in range(2 * half + 1):
                        ex, ey = (i - half) * cell - at[0], (j - half) * cell - at[1]
                        along, across = unit * (at[3] * ex + at[4] * ey), unit * (at[3] * ey - at[4] * ex)
                        row, squared, facing = 0, ex * ex + ey * ey, 0.0
                        if layers > 1:
                            facing = -(nx * ex + ny * ey) / math.sqrt(squared + 1e-9)
                        if squared < reach2 if by_reach else max(abs(along), abs(across)) < edge:
                            row = row_of(packed, tables, a, level, along, across, heights[h], facing)
                        log_q, log_p = none[a]
                        if row > 0:
                            log_q, log_p = logs[m, row, 0], logs[m, row, 1]
                        gain[a, h, f, i, j] = log_q - log_p
                        missed[a, h, f, i, j] = log_p - none[a, 1]
