"""Tabulated likelihood of RFID reads for many poses without derivatives, for particles.

A table holds the field of an antenna model at one height of tags, in cells of :data:`CELL`, and with facings if the model uses
them. The outer loop runs over tags, because all poses access nearby cells for one tag.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from factors.rfid.adjustment import rates
from factors.rfid.kernels import FAST, seen
from factors.rfid.model import LOGISTIC, NEAR, NEGLIGIBLE_LOGIT, Packed, RfidModel, logistic_value
from factors.se2 import Array

Array32 = NDArray[np.float32]
Floats = Array32 | Array

CELL = 0.05  # m
FACINGS = 9  # knots of the facing's cosine
NEGLIGIBLE = 15.0  # log of the ratio of two likelihoods of which the smaller one does not count
STEP, LEVEL = 0.01, 0.04  # of the logit, in the tables of logarithms; m of height within which tags share a table
SHIFTS = np.linspace(-4.0, 4.0, 161)  # of a peak's logit, each with tables of logarithms of its own


class Tables(NamedTuple):
    """``logits``: indices into ``logs`` of all tables, each (F, NX, NX), and ``missed``: log(1 - q) there; ``start`` (L,): first
    index of each table; ``half`` (L,): knots from its middle to its edge; ``facings`` (L,); ``level`` (A, T): table of each
    antenna and tag; ``logs`` (Z, 2): log q and log(1 - q) for logits :data:`STEP` apart, from :data:`NEGLIGIBLE_LOGIT` to its
    negative."""

    logits: NDArray[np.uint16]
    missed: NDArray[np.float32]
    start: NDArray[np.int64]
    half: NDArray[np.int64]
    facings: NDArray[np.int64]
    level: NDArray[np.int64]
    logs: Array


class Changes(NamedTuple):
    """How each of N poses adjusts the model of an antenna (:mod:`factors.rfid.adjustment`).

    ``unit`` (N,): 1 / scale; ``level`` (N,): its place in ``logs`` (K, Z, 2), which are log q and log(1 - q) of the logits of
    :class:`Tables`, for K shifts of the peak's logit.
    """

    unit: Array
    level: NDArray[np.int32]
    logs: Array32


def levels(shift: Array) -> NDArray[np.int32]:
    """Places (N,) of shifts among :data:`SHIFTS`."""
    step = SHIFTS[1] - SHIFTS[0]
    return np.asarray(np.clip(np.rint((shift - SHIFTS[0]) / step), 0, len(SHIFTS) - 1), dtype=np.int32)


def adjusted_logs(packed: Packed, peak: float) -> Array32:
    """Log q and log(1 - q), (K, Z, 2), for :data:`SHIFTS` of the logit of a model's ``peak``."""
    z = np.arange(round(-2.0 * NEGLIGIBLE_LOGIT / STEP) + 1) * STEP + NEGLIGIBLE_LOGIT
    q = packed.false_read + packed.span * rates(np.asarray(peak), SHIFTS)[:, None] / (1.0 + np.exp(-z))
    q = np.clip(q, 1e-12, 1.0 - 1e-12)
    return np.asarray(np.log(np.stack((q, 1.0 - q), axis=-1)), dtype=np.float32)


def make_tables(model: RfidModel, packed: Packed, heights: Array) -> Tables:
    """One table for each model, pitch and height difference, for tags at ``heights`` (T,) [m]."""
    z = np.arange(round(-2.0 * NEGLIGIBLE_LOGIT / STEP) + 1) * STEP + NEGLIGIBLE_LOGIT
    q = packed.false_read + packed.span / (1.0 + np.exp(-z))
    with np.errstate(divide="ignore"):
        logs = np.log(np.column_stack((q, 1.0 - q)))
    numbers: dict[tuple[int, float, int], int] = {}
    level = np.zeros((len(model.antennas), len(heights)), dtype=np.int64)
    tables: list[NDArray[np.uint16]] = []
    halves: list[int] = []
    for i, antenna in enumerate(model.antennas):
        detection = model.models[antenna.model]
        if packed.kinds[antenna.model] == LOGISTIC:
            continue
        steps, which = np.unique(np.rint((heights - antenna.z) / LEVEL).astype(np.int64), return_inverse=True)
        found = np.zeros(len(steps), dtype=np.int64)
        for j, step in enumerate(steps.tolist()):
            key = (antenna.model, antenna.pitch, step)
            if key not in numbers:
                numbers[key] = len(tables)
                half = math.ceil(detection.reach / CELL)
                table = np.empty((FACINGS if detection.uses_facing else 1, 2 * half + 1, 2 * half + 1), np.uint16)
                _fill(packed, i, key[2] * LEVEL, half, table)
                tables.append(table)
                halves.append(half)
            found[j] = numbers[key]
        level[i] = found[which]
    sizes = np.array([t.size for t in tables], dtype=np.int64)
    logits = np.concatenate([t.ravel() for t in tables]) if tables else np.empty(0, np.uint16)
    return Tables(
        logits,
        logs[logits, 1].astype(np.float32),
        np.concatenate((np.zeros(1, np.int64), np.cumsum(sizes)))[: len(tables)],
        np.array(halves, dtype=np.int64),
        np.array([len(t) for t in tables], dtype=np.int64),
        level,
        logs,
    )


def add_log_likelihood(
    packed: Packed,
    tables: Tables,
    antenna: int,
    poses: Array,
    points: Array,
    normals: Array,
    hits: NDArray[np.int64],
    rounds: int,
    apart: NDArray[np.int64],
    out: Array,
    each: Floats,
    changes: Changes | None = None,
) -> None:
    """Add to ``out`` (N,) the log-likelihood, untempered, that one antenna at robot's poses (N, 3) reads each tag at ``points``
    (T, 3) with ``normals`` (T, 2) in ``hits`` (T,) of ``rounds`` rounds. ``apart`` (T,): in which row of ``each`` (U, N) a tag is
    added by itself, above that of a silence out of reach, -1 of tags that go to ``out``; with its precision the cells are found.
    ``changes``: of the model, by pose."""
    arrays = (points, normals, hits, rounds, apart)
    if changes is None:
        changes = Changes(np.ones(len(poses)), np.empty(0, np.int32), np.empty((0, 0, 2), np.float32))
    if packed.kinds[packed.which[antenna]] == LOGISTIC:
        _add_direct(packed, antenna, poses, *arrays, tables.logs, changes, out, each)
    else:
        _add_tabled(packed, antenna, poses, *arrays, tables, tables.level[antenna], changes, out, each)


@numba.njit(cache=True, fastmath=FAST)
def add_mixed(each: Floats, odds: Array, elsewhere: Array, tempering: float, out: Array) -> None:
    """Add to ``out`` (N,) the tempered log-likelihood of U tags that are, with prior log-odds ``odds`` (U,), not as surveyed, in
    which case theirs is ``elsewhere`` (U,); ``each`` (U, N): that of tags as surveyed (:mod:`factors.rfid.tag_states`)."""
    for u in range(len(odds)):
        other = odds[u] + elsewhere[u]
        both = max(odds[u], 0.0) + math.log1p(math.exp(-abs(odds[u])))
        for n in range(len(out)):
            own = tempering * each[u, n]
            if abs(own - other) > NEGLIGIBLE:
                out[n] += max(own, other) - both
            else:
                out[n] += own + math.log1p(math.exp(other - own)) - both


@numba.njit(cache=True)
def logit_row(z: float) -> int:
    """Index of a logit in the tables of logarithms."""
    return int((min(max(z, NEGLIGIBLE_LOGIT), -NEGLIGIBLE_LOGIT) - NEGLIGIBLE_LOGIT) / STEP + 0.5)


@numba.njit(cache=True)
def _fill(packed: Packed, antenna: int, height: float, half: int, table: NDArray[np.uint16]) -> None:
    facings = len(table)
    for f in range(facings):
        c = 2.0 * f / (facings - 1) - 1.0 if facings > 1 else 0.0
        for i in range(2 * half + 1):
            for j in range(2 * half + 1):
                z = seen(packed, antenna, (i - half) * CELL, (j - half) * CELL, height, c)[0]
                table[f, i, j] = logit_row(z)


@numba.njit(cache=True)
def _out_of_reach(poses: Array, points: Array, reach: float) -> NDArray[np.bool_]:
    """The tags (T,) that are out of range of an antenna with this reach for all poses."""
    low_x = high_x = poses[0, 0]
    low_y = high_y = poses[0, 1]
    for n in range(1, len(poses)):
        low_x, high_x = min(low_x, poses[n, 0]), max(high_x, poses[n, 0])
        low_y, high_y = min(low_y, poses[n, 1]), max(high_y, poses[n, 1])
    out = np.empty(len(points), np.bool_)
    for t in range(len(points)):
        x, y = points[t, 0], points[t, 1]
        dx, dy = max(low_x - x, 0.0, x - high_x), max(low_y - y, 0.0, y - high_y)
        out[t] = dx * dx + dy * dy >= reach * reach
    return out


@numba.njit(cache=True, fastmath=True)
def _add_tabled(
    packed: Packed,
    antenna: int,
    poses: Array,
    points: Array,
    normals: Array,
    hits: NDArray[np.int64],
    rounds: int,
    apart: NDArray[np.int64],
    tables: Tables,
    level: NDArray[np.int64],
    changes: Changes,
    out: Array,
    each: Floats,
) -> None:
    a = packed.antennas[antenna]
    ax, ay, ca, sa = a[0], a[1], a[3], a[4]
    logs = tables.logs
    far = _out_of_reach(poses, points, _reach(packed, antenna, changes))
    # place and direction of the antenna at each pose, in cells
    x, y = np.empty(len(poses), each.dtype), np.empty(len(poses), each.dtype)
    c, s = np.empty(len(poses), each.dtype), np.empty(len(poses), each.dtype)
    place = np.empty(2, each.dtype)
    inverse = 1.0 / CELL
    middle_x, middle_y = poses[0, 0], poses[0, 1]
    for n in range(len(poses)):
        ct, st = math.cos(poses[n, 2]), math.sin(poses[n, 2])
        x[n] = (poses[n, 0] - middle_x + ct * ax - st * ay) * inverse
        y[n] = (poses[n, 1] - middle_y + st * ax + ct * ay) * inverse
        unit = changes.unit[n]
        c[n], s[n] = unit * (ct * ca - st * sa), unit * (st * ca + ct * sa)
    constant = 0.0
    # tags in the outer loop, because all poses access nearby cells for one tag
    certain = np.zeros(len(poses), each.dtype)
    for t in range(len(points)):
        if far[t]:
            constant += _far(apart[t], hits[t], rounds, logs, each)
            continue
        total = certain
        if apart[t] >= 0:
            total = each[apart[t]]
            constant += rounds * logs[0, 1]
            for n in range(len(poses)):
                total[n] -= np.float32(rounds * logs[0, 1])
        k = level[t]
        place[0], place[1] = (points[t, 0] - middle_x) * inverse, (points[t, 1] - middle_y) * inverse
        tx, ty = place[0], place[1]
        size = 2 * tables.half[k] + 1
        layers = tables.facings[k]
        begin = tables.start[k]
        table = tables.logits[begin : begin + layers * size * size]
        if layers > 1:
            _add_facing(x, y, c, s, tx, ty, table, size, layers, normals[t], hits[t], rounds, logs, changes, total)
            continue
        if len(changes.level) == 0 and hits[t] == 0:
            _add_missed(x, y, c, s, tx, ty, tables.missed[begin : begin + size * size], size, np.float32(rounds), total)
            continue
        ends = np.int32(size - 1)
        to_middle = np.float32(tables.half[k] + 0.5)
        for n in range(len(poses)):
            ex, ey = tx - x[n], ty - y[n]
            i = min(max(np.int32(c[n] * ex + s[n] * ey + to_middle), np.int32(0)), ends)
            j = min(max(np.int32(c[n] * ey - s[n] * ex + to_middle), np.int32(0)), ends)
            total[n] += np.float32(_read(table[i * size + j], hits[t], rounds, logs, changes, n))
    for n in range(len(poses)):
        out[n] += constant + certain[n]


@numba.njit(cache=True)
def _far(row: int, hits: int, rounds: int, logs: Array, each: Floats) -> float:
    """What a tag that is out of reach from all poses adds to each of them, besides what goes to its own row, if it has one."""
    if row < 0:
        return float(hits * logs[0, 0] + (rounds - hits) * logs[0, 1])
    if hits > 0:
        for n in range(each.shape[1]):
            each[row, n] += np.float32(hits * (logs[0, 0] - logs[0, 1]))
    return float(rounds * logs[0, 1])


@numba.njit(cache=True)
def _reach(packed: Packed, antenna: int, changes: Changes) -> float:
    """How far an antenna reaches from the robot's middle at most."""
    a = packed.antennas[antenna]
    return float(packed.reach[packed.which[antenna]] / np.min(changes.unit) + math.sqrt(a[0] * a[0] + a[1] * a[1]))


@numba.njit(cache=True, fastmath=True, inline="always")
def _read(row: int, hits: int, rounds: int, logs: Array, changes: Changes, n: int) -> float:
    """Log-likelihood of hits at a place of the tables of logarithms, for pose n."""
    if len(changes.level) == 0:
        return float(hits * logs[row, 0] + (rounds - hits) * logs[row, 1])
    level = changes.level[n]
    return float(hits * changes.logs[level, row, 0] + (rounds - hits) * changes.logs[level, row, 1])


@numba.njit(cache=True, fastmath=True)
def _add_missed(
    x: Floats,
    y: Floats,
    c: Floats,
    s: Floats,
    tx: np.float32,
    ty: np.float32,
    missed: Array32,
    size: int,
    rounds: np.float32,
    total: Floats,
) -> None:
    """Add a tag that was not read, the most frequent case."""
    width, ends = np.int32(size), np.int32(size - 1)
    to_middle = np.float32((size - 1) // 2 + 0.5)
    for n in range(len(x)):
        ex, ey = tx - x[n], ty - y[n]
        # constant beyond the edge of the table
        i = min(max(np.int32(c[n] * ex + s[n] * ey + to_middle), np.int32(0)), ends)
        j = min(max(np.int32(c[n] * ey - s[n] * ex + to_middle), np.int32(0)), ends)
        total[n] += rounds * missed[np.int32(i * width + j)]


@numba.njit(cache=True, fastmath=True)
def _add_facing(
    x: Floats,
    y: Floats,
    c: Floats,
    s: Floats,
    tx: np.float32,
    ty: np.float32,
    table: NDArray[np.uint16],
    size: int,
    layers: int,
    normal: Array,
    hits: int,
    rounds: int,
    logs: Array,
    changes: Changes,
    total: Floats,
) -> None:
    """Add a tag with facing, interpolated between two layers of its table."""
    ends = size - 1
    to_middle = np.float32((size - 1) // 2 + 0.5)
    for n in range(len(x)):
        ex, ey = tx - x[n], ty - y[n]
        i = min(max(int(c[n] * ex + s[n] * ey + to_middle), 0), ends)
        j = min(max(int(c[n] * ey - s[n] * ex + to_middle), 0), ends)
        cosine = -(normal[0] * ex + normal[1] * ey) / math.sqrt(ex * ex + ey * ey + 1e-6)
        f = (cosine + 1.0) * 0.5 * (layers - 1)
        below = min(int(f), layers - 2)
        place = (below * size + i) * size + j
        low, high = table[place], table[place + size * size]
        row = int(low + (f - below) * (np.float64(high) - low) + 0.5)
        total[n] += np.float32(_read(row, hits, rounds, logs, changes, n))


@numba.njit(cache=True, fastmath=True)
def _add_direct(
    packed: Packed,
    antenna: int,
    poses: Array,
    points: Array,
    normals: Array,
    hits: NDArray[np.int64],
    rounds: int,
    apart: NDArray[np.int64],
    logs: Array,
    changes: Changes,
    out: Array,
    each: Floats,
) -> None:
    """The same for a logistic model, which is faster to compute than to look up for all facings."""
    m = packed.which[antenna]
    b = packed.parameters[m]
    reach2 = packed.reach[m] ** 2
    ax, ay, az = packed.antennas[antenna, 0], packed.antennas[antenna, 1], packed.antennas[antenna, 2]
    ca, sa, cp, sp = (
        packed.antennas[antenna, 3],
        packed.antennas[antenna, 4],
        packed.antennas[antenna, 5],
        packed.antennas[antenna, 6],
    )
    none_hit, none_missed = logs[0, 0], logs[0, 1]
    near = np.flatnonzero(~_out_of_reach(poses, points, _reach(packed, antenna, changes)))
    far = np.ones(len(points), np.bool_)
    far[near] = False
    constant = 0.0
    for t in np.flatnonzero(far):
        constant += _far(apart[t], hits[t], rounds, logs, each)
    for n in range(len(poses)):
        ct, st = math.cos(poses[n, 2]), math.sin(poses[n, 2])
        x, y = poses[n, 0] + ct * ax - st * ay, poses[n, 1] + st * ax + ct * ay
        cosine, sine = ct * ca - st * sa, st * ca + ct * sa
        total = constant
        for t in near:
            ex, ey = points[t, 0] - x, points[t, 1] - y
            distance2 = ex * ex + ey * ey
            unit = changes.unit[n]
            if unit * unit * distance2 >= reach2:
                total += rounds * none_missed
                if apart[t] >= 0:
                    each[apart[t], n] += np.float32(hits[t] * (none_hit - none_missed))
                else:
                    total += hits[t] * (none_hit - none_missed)
                continue
            height = points[t, 2] - az
            along, across = unit * (cosine * ex + sine * ey), unit * (cosine * ey - sine * ex)
            u, z = cp * along + sp * height, cp * height - sp * along
            r = math.sqrt(u * u + across * across + NEAR * NEAR)
            c = -(normals[t, 0] * ex + normals[t, 1] * ey) / math.sqrt(distance2 + 1e-9)
            w = 1.0 - u / r
            row = logit_row(logistic_value(b, r, w, z, c))
            if apart[t] >= 0:
                each[apart[t], n] += np.float32(_read(row, hits[t], rounds, logs, changes, n) - rounds * none_missed)
                total += rounds * none_missed
            else:
                total += _read(row, hits[t], rounds, logs, changes, n)
        out[n] += total
