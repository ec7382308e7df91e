"""The likelihood of what RFID antennas read and did not read, of many poses at once, with gradient and Fisher information.

Each antenna that listens for a tag in n inventory rounds reads it in k of them, with probability q each
(:mod:`factors.rfid`): the negative log-likelihood is ``-tempering * sum(k log q + (n - k) log(1 - q))``. Its Hessian is replaced by
the expected one, Fisher's information, which is never indefinite.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.rfid import LOGISTIC, NEGLIGIBLE_LOGIT, Packed, RfidModel, logit
from factors.se2 import Array

Array32 = NDArray[np.float32]

CELL = 0.05  # m, of the tables that many poses are looked up in
FACINGS = 9  # knots of the facing's cosine in them
STEP = 0.01  # of the logit, in the tables of logarithms
LEVEL = 0.01  # m: tags at the same height, to so much, share a table


@dataclass(frozen=True, eq=False)
class TagArray:
    """T tags: ``points`` (T, 3) [m] in the world and ``facing`` (T,) [rad], NaN where it is not known."""

    points: Array
    facing: Array

    @cached_property
    def normals(self) -> Array:
        """The directions (T, 2) in which the tags face, zero where that is not known."""
        known = np.isfinite(self.facing)
        angle = np.where(known, self.facing, 0.0)
        return np.where(known[:, None], np.column_stack((np.cos(angle), np.sin(angle))), 0.0)


@dataclass(frozen=True, eq=False)
class Looks:
    """What K antennas read of T tags, each at its own place on the way.

    ``offsets`` (K, 3): the robot's pose at the look, in the frame of the pose that the likelihood is of; ``antennas`` (K,): places
    in the model; ``rounds`` (K,): inventory rounds; ``hits`` (K, T): in how many of them each tag was read.
    """

    offsets: Array
    antennas: NDArray[np.int64]
    rounds: NDArray[np.int64]
    hits: NDArray[np.int64]

    def moved(self, offset: Array) -> Looks:
        """The same looks, of the pose that lies ``offset`` (3,) before theirs."""
        return Looks(se2.compose(offset, self.offsets), self.antennas, self.rounds, self.hits)


def together(parts: list[Looks]) -> Looks:
    """Several looks as one, all of the same pose."""
    return Looks(
        np.concatenate([p.offsets for p in parts]),
        np.concatenate([p.antennas for p in parts]),
        np.concatenate([p.rounds for p in parts]),
        np.concatenate([p.hits for p in parts]),
    )


class Score(NamedTuple):
    """Of N poses, all tempered. ``nll`` (N,); ``gradient`` (N, 3) and ``information`` (N, 3, 3) by body-frame perturbation;
    ``expected`` (N,) and ``variance`` (N,): mean and variance of ``nll`` if model and pose are right. The variance too is in
    proportion to the tempering, which stands for how much the reads go together."""

    nll: Array
    gradient: Array
    information: Array
    expected: Array
    variance: Array


@dataclass(frozen=True, eq=False)
class RfidLikelihood:
    """The likelihood of an antenna model with a map of tags."""

    model: RfidModel
    tags: TagArray
    _packed: Packed = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_packed", self.model.packed())

    def score(self, poses: Array, looks: Looks) -> Score:
        """Likelihood, gradient and information at poses (N, 3)."""
        poses = np.ascontiguousarray(np.atleast_2d(poses), dtype=float)
        n = len(poses)
        out = Score(np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n), np.empty(n))
        arrays = (looks.offsets, looks.antennas, looks.rounds, looks.hits)
        _score(self._packed, poses, self.tags.points, self.tags.normals, *arrays, *out)
        return Score(*(self.model.tempering * part for part in out))

    def log_likelihood(self, poses: Array, looks: Looks) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3), from tables of :data:`CELL` size: for particles."""
        tables = self._tables
        out = np.zeros(len(poses))
        poses = np.ascontiguousarray(poses, dtype=float)
        for i in range(len(looks.antennas)):
            at = poses if not looks.offsets[i].any() else se2.compose(poses, looks.offsets[i])
            antenna, rounds = int(looks.antennas[i]), int(looks.rounds[i])
            arrays = (self.tags.points, self.tags.normals, looks.hits[i])
            if self._packed.kinds[self._packed.which[antenna]] == LOGISTIC:
                _add_direct(self._packed, antenna, at, *arrays, rounds, tables.logs, out)
            else:
                _add_tabled(self._packed, antenna, at, *arrays, rounds, tables, tables.level[antenna], out)
        return self.model.tempering * out

    @cached_property
    def _tables(self) -> _Tables:
        return _make_tables(self.model, self._packed, self.tags)

    def by_tag(self, pose: Array, looks: Looks) -> tuple[Array, Array, Array]:
        """What each tag says on its own, at one pose (3,): tempered negative log-likelihood (T,), its gradient (T, 2) by the tag's
        position in the world, and information (T, 2, 2)."""
        count = len(self.tags.points)
        nll, gradient, information = np.zeros(count), np.zeros((count, 2)), np.zeros((count, 2, 2))
        arrays = (looks.offsets, looks.antennas, looks.rounds, looks.hits)
        pose = np.asarray(pose, dtype=float)
        _by_tag(self._packed, pose, self.tags.points, self.tags.normals, *arrays, nll, gradient, information)
        alpha = self.model.tempering
        return alpha * nll, alpha * gradient, alpha * information

    def probabilities(self, poses: Array, antenna: int) -> Array:
        """Probability (N, T), floor included, that a round of an antenna reads each tag from poses (N, 3)."""
        out = np.empty((len(poses), len(self.tags.points)))
        poses = np.ascontiguousarray(poses, dtype=float)
        _probabilities(self._packed, antenna, poses, self.tags.points, self.tags.normals, out)
        return out


class _Tables(NamedTuple):
    """``logits``: places in ``logs`` of all tables, one after another, each (F, NX, NX), and ``missed``: log(1 - q) there;
    ``start`` (L,): first place of each;
    ``half`` (L,): knots from its middle to its edge; ``facings`` (L,); ``level`` (A, T): which table an antenna has for a tag;
    ``logs`` (Z, 2): log q and log(1 - q) of logits :data:`STEP` apart, from :data:`NEGLIGIBLE_LOGIT` to its negative."""

    logits: NDArray[np.uint16]
    missed: NDArray[np.float32]
    start: NDArray[np.int64]
    half: NDArray[np.int64]
    facings: NDArray[np.int64]
    level: NDArray[np.int64]
    logs: Array


def _make_tables(model: RfidModel, packed: Packed, tags: TagArray) -> _Tables:
    """One table for each model, pitch and height difference that there is."""
    z = np.arange(round(-2.0 * NEGLIGIBLE_LOGIT / STEP) + 1) * STEP + NEGLIGIBLE_LOGIT
    q = packed.false_read + packed.span / (1.0 + np.exp(-z))
    with np.errstate(divide="ignore"):
        logs = np.log(np.column_stack((q, 1.0 - q)))
    numbers: dict[tuple[int, float, int], int] = {}
    level = np.zeros((len(model.antennas), len(tags.points)), dtype=np.int64)
    tables: list[NDArray[np.uint16]] = []
    halves: list[int] = []
    for i, antenna in enumerate(model.antennas):
        detection = model.models[antenna.model]
        if packed.kinds[antenna.model] == LOGISTIC:
            continue
        for j, height in enumerate(tags.points[:, 2] - antenna.z):
            key = (antenna.model, antenna.pitch, round(float(height) / LEVEL))
            if key not in numbers:
                numbers[key] = len(tables)
                half = math.ceil(detection.reach / CELL)
                table = np.empty((FACINGS if detection.uses_facing else 1, 2 * half + 1, 2 * half + 1), np.uint16)
                _fill(packed, i, key[2] * LEVEL, half, table)
                tables.append(table)
                halves.append(half)
            level[i, j] = numbers[key]
    sizes = np.array([t.size for t in tables], dtype=np.int64)
    logits = np.concatenate([t.ravel() for t in tables]) if tables else np.empty(0, np.uint16)
    return _Tables(
        logits,
        logs[logits, 1].astype(np.float32),
        np.concatenate((np.zeros(1, np.int64), np.cumsum(sizes)))[: len(tables)],
        np.array(halves, dtype=np.int64),
        np.array([len(t) for t in tables], dtype=np.int64),
        level,
        logs,
    )


@numba.njit(cache=True)
def _index(z: float) -> int:
    """Place of a logit in the tables of logarithms."""
    return int((min(max(z, NEGLIGIBLE_LOGIT), -NEGLIGIBLE_LOGIT) - NEGLIGIBLE_LOGIT) / STEP + 0.5)


@numba.njit(cache=True)
def _seen(
    packed: Packed, antenna: int, p: float, q: float, height: float, c: float
) -> tuple[float, float, float, float, float]:
    """Logit of a tag at (p, q, height) from the antenna, in axes turned by its yaw alone, and derivatives by p, q, height, c."""
    cp, sp = packed.antennas[antenna, 5], packed.antennas[antenna, 6]
    m = packed.which[antenna]
    x, z = cp * p + sp * height, cp * height - sp * p
    value, by_x, by_y, by_z, by_c = logit(
        packed.kinds[m], packed.parameters[m], packed.shapes[m], packed.knots, x, q, z, c
    )
    return value, cp * by_x - sp * by_z, by_y, sp * by_x + cp * by_z, by_c


@numba.njit(cache=True)
def _fill(packed: Packed, antenna: int, height: float, half: int, table: NDArray[np.uint16]) -> None:
    facings = len(table)
    for f in range(facings):
        c = 2.0 * f / (facings - 1) - 1.0 if facings > 1 else 0.0
        for i in range(2 * half + 1):
            for j in range(2 * half + 1):
                z = _seen(packed, antenna, (i - half) * CELL, (j - half) * CELL, height, c)[0]
                table[f, i, j] = _index(z)


@numba.njit(cache=True)
def _out_of_reach(poses: Array, points: Array, reach: float) -> NDArray[np.bool_]:
    """Which tags (T,) no robot at any of the poses, with an antenna that reaches so far from its middle, can read."""
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
    tables: _Tables,
    level: NDArray[np.int64],
    out: Array,
) -> None:
    a = packed.antennas[antenna]
    ax, ay, ca, sa = a[0], a[1], a[3], a[4]
    logs = tables.logs
    far = _out_of_reach(poses, points, packed.reach[packed.which[antenna]] + math.sqrt(ax * ax + ay * ay))
    # place and direction of the antenna at each pose, in cells
    x, y = np.empty(len(poses), np.float32), np.empty(len(poses), np.float32)
    c, s = np.empty(len(poses), np.float32), np.empty(len(poses), np.float32)
    inverse = 1.0 / CELL
    middle_x, middle_y = poses[0, 0], poses[0, 1]
    for n in range(len(poses)):
        ct, st = math.cos(poses[n, 2]), math.sin(poses[n, 2])
        x[n] = (poses[n, 0] - middle_x + ct * ax - st * ay) * inverse
        y[n] = (poses[n, 1] - middle_y + st * ax + ct * ay) * inverse
        c[n], s[n] = ct * ca - st * sa, st * ca + ct * sa
    constant = 0.0
    # tag by tag, as all poses look at places of its table that are close together
    total = np.zeros(len(poses), np.float32)
    for t in range(len(points)):
        if far[t]:
            constant += hits[t] * logs[0, 0] + (rounds - hits[t]) * logs[0, 1]
            continue
        k = level[t]
        tx, ty = np.float32((points[t, 0] - middle_x) * inverse), np.float32((points[t, 1] - middle_y) * inverse)
        size = 2 * tables.half[k] + 1
        layers = tables.facings[k]
        begin = tables.start[k]
        table = tables.logits[begin : begin + layers * size * size]
        if layers > 1:
            _add_facing(x, y, c, s, tx, ty, table, size, layers, normals[t], hits[t], rounds, logs, total)
            continue
        if hits[t] == 0:
            _add_missed(x, y, c, s, tx, ty, tables.missed[begin : begin + size * size], size, np.float32(rounds), total)
            continue
        ends = np.int32(size - 1)
        to_middle = np.float32(tables.half[k] + 0.5)
        for n in range(len(poses)):
            ex, ey = tx - x[n], ty - y[n]
            i = min(max(np.int32(c[n] * ex + s[n] * ey + to_middle), np.int32(0)), ends)
            j = min(max(np.int32(c[n] * ey - s[n] * ex + to_middle), np.int32(0)), ends)
            row = table[i * size + j]
            total[n] += np.float32(hits[t] * logs[row, 0] + (rounds - hits[t]) * logs[row, 1])
    for n in range(len(poses)):
        out[n] += constant + total[n]


@numba.njit(cache=True, fastmath=True)
def _add_missed(
    x: Array32,
    y: Array32,
    c: Array32,
    s: Array32,
    tx: np.float32,
    ty: np.float32,
    missed: Array32,
    size: int,
    rounds: np.float32,
    total: Array32,
) -> None:
    """The commonest case: a tag that was not read."""
    width, ends = np.int32(size), np.int32(size - 1)
    to_middle = np.float32((size - 1) // 2 + 0.5)
    for n in range(len(x)):
        ex, ey = tx - x[n], ty - y[n]
        # beyond the table nothing is left, as at its edge
        i = min(max(np.int32(c[n] * ex + s[n] * ey + to_middle), np.int32(0)), ends)
        j = min(max(np.int32(c[n] * ey - s[n] * ex + to_middle), np.int32(0)), ends)
        total[n] += rounds * missed[np.int32(i * width + j)]


@numba.njit(cache=True, fastmath=True)
def _add_facing(
    x: Array32,
    y: Array32,
    c: Array32,
    s: Array32,
    tx: np.float32,
    ty: np.float32,
    table: NDArray[np.uint16],
    size: int,
    layers: int,
    normal: Array,
    hits: int,
    rounds: int,
    logs: Array,
    total: Array32,
) -> None:
    """A tag whose facing matters: between two layers of its table."""
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
        total[n] += np.float32(hits * logs[row, 0] + (rounds - hits) * logs[row, 1])


@numba.njit(cache=True, fastmath=True)
def _add_direct(
    packed: Packed,
    antenna: int,
    poses: Array,
    points: Array,
    normals: Array,
    hits: NDArray[np.int64],
    rounds: int,
    logs: Array,
    out: Array,
) -> None:
    """The same for a logistic model, which is computed faster than it is looked up for all facings."""
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
    far = _out_of_reach(poses, points, packed.reach[m] + math.sqrt(ax * ax + ay * ay))
    near = np.flatnonzero(~far)
    constant = 0.0
    for t in np.flatnonzero(far):
        constant += hits[t] * none_hit + (rounds - hits[t]) * none_missed
    for n in range(len(poses)):
        ct, st = math.cos(poses[n, 2]), math.sin(poses[n, 2])
        x, y = poses[n, 0] + ct * ax - st * ay, poses[n, 1] + st * ax + ct * ay
        cosine, sine = ct * ca - st * sa, st * ca + ct * sa
        total = constant
        for t in near:
            ex, ey = points[t, 0] - x, points[t, 1] - y
            distance2 = ex * ex + ey * ey
            if distance2 >= reach2:
                total += hits[t] * none_hit + (rounds - hits[t]) * none_missed
                continue
            height = points[t, 2] - az
            along, across = cosine * ex + sine * ey, cosine * ey - sine * ex
            u, z = cp * along + sp * height, cp * height - sp * along
            r = math.sqrt(u * u + across * across + 1e-4)
            c = -(normals[t, 0] * ex + normals[t, 1] * ey) / math.sqrt(distance2 + 1e-9)
            w = 1.0 - u / r
            value = b[0] + r * (b[1] + b[2] * r) + w * (b[3] + b[4] * w + b[5] * r) + b[6] * abs(z)
            value += c * (b[7] + b[8] * c + b[9] * r + b[10] * w)
            row = _index(value)
            total += hits[t] * logs[row, 0] + (rounds - hits[t]) * logs[row, 1]
        out[n] += total


@numba.njit(cache=True)
def _placed(
    packed: Packed, antenna: int, pose: Array, offset: Array
) -> tuple[float, float, float, float, float, float]:
    """Where an antenna is in the world (x, y, cosine and sine of its heading), for a robot at ``offset`` from ``pose``; and the
    cosine and sine of the robot's heading."""
    c0, s0 = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] + c0 * offset[0] - s0 * offset[1], pose[1] + s0 * offset[0] + c0 * offset[1]
    c, s = math.cos(pose[2] + offset[2]), math.sin(pose[2] + offset[2])
    a = packed.antennas[antenna]
    x, y = x + c * a[0] - s * a[1], y + s * a[0] + c * a[1]
    return x, y, c * a[3] - s * a[4], s * a[3] + c * a[4], c, s


@numba.njit(cache=True)
def _of_tag(
    packed: Packed, antenna: int, x: float, y: float, c: float, s: float, point: Array, normal: Array
) -> tuple[float, float, float, float]:
    """Logit of one tag for an antenna at (x, y) that looks along (c, s), and its derivatives: by the tag's place along and across
    the boresight, and by the antenna's heading. Beyond the reach it is constant."""
    ex, ey = point[0] - x, point[1] - y
    m = packed.which[antenna]
    squared = ex * ex + ey * ey
    if squared >= packed.reach[m] ** 2:
        return NEGLIGIBLE_LOGIT, 0.0, 0.0, 0.0
    p, q = c * ex + s * ey, c * ey - s * ex
    nx, ny = c * normal[0] + s * normal[1], c * normal[1] - s * normal[0]
    distance = math.sqrt(squared + 1e-9)
    facing = -(nx * p + ny * q) / distance
    value, by_p, by_q, _, by_c = _seen(packed, antenna, p, q, point[2] - packed.antennas[antenna, 2], facing)
    by_heading = by_p * q - by_q * p
    by_p -= by_c * (nx + facing * p / distance) / distance
    by_q -= by_c * (ny + facing * q / distance) / distance
    return value, by_p, by_q, by_heading


@numba.njit(cache=True)
def _terms(packed: Packed, z: float, hits: int, rounds: int) -> tuple[float, float, float, float, float]:
    """Negative log-likelihood of k hits in n rounds, its derivative by the logit, Fisher's information on the logit, and mean and
    variance of the negative log-likelihood."""
    sigmoid = 1.0 / (1.0 + math.exp(-max(z, NEGLIGIBLE_LOGIT)))
    q = packed.false_read + packed.span * sigmoid
    # a model without a floor may be certain, and certainty has no logarithm
    q = min(max(q, 1e-12), 1.0 - 1e-12)
    by_z = packed.span * sigmoid * (1.0 - sigmoid)
    log_q, log_p = math.log(q), math.log1p(-q)
    nll = -(hits * log_q + (rounds - hits) * log_p)
    gradient = -(hits / q - (rounds - hits) / (1.0 - q)) * by_z
    information = rounds * by_z * by_z / (q * (1.0 - q))
    expected = -rounds * (q * log_q + (1.0 - q) * log_p)
    variance = rounds * q * (1.0 - q) * (log_q - log_p) ** 2
    return nll, gradient, information, expected, variance


@numba.njit(cache=True)
def _score(
    packed: Packed,
    poses: Array,
    points: Array,
    normals: Array,
    offsets: Array,
    antennas: NDArray[np.int64],
    rounds: NDArray[np.int64],
    hits: NDArray[np.int64],
    nll: Array,
    gradient: Array,
    information: Array,
    expected: Array,
    variance: Array,
) -> None:
    nll[:] = 0.0
    gradient[:] = 0.0
    information[:] = 0.0
    expected[:] = 0.0
    variance[:] = 0.0
    by = np.empty(3)
    for n in range(len(poses)):
        for k in range(len(antennas)):
            a = antennas[k]
            x, y, c, s, _, _ = _placed(packed, a, poses[n], offsets[k])
            ca, sa = packed.antennas[a, 3], packed.antennas[a, 4]
            lx, ly = packed.antennas[a, 0], packed.antennas[a, 1]
            co, so = math.cos(offsets[k, 2]), math.sin(offsets[k, 2])
            # of the antenna's boresight in the frame of the pose, and the antenna's place there
            cb, sb = co * ca - so * sa, so * ca + co * sa
            px, py = offsets[k, 0] + co * lx - so * ly, offsets[k, 1] + so * lx + co * ly
            for t in range(len(points)):
                z, by_p, by_q, by_heading = _of_tag(packed, a, x, y, c, s, points[t], normals[t])
                e, g, f, mean, spread = _terms(packed, z, hits[k, t], rounds[k])
                nll[n] += e
                expected[n] += mean
                variance[n] += spread
                if f == 0.0 and g == 0.0:
                    continue
                # the antenna moves, the tag does not
                gx, gy = cb * by_p - sb * by_q, sb * by_p + cb * by_q
                by[0], by[1], by[2] = -gx, -gy, by_heading + gx * py - gy * px
                for i in range(3):
                    gradient[n, i] += g * by[i]
                    for j in range(3):
                        information[n, i, j] += f * by[i] * by[j]


@numba.njit(cache=True)
def _by_tag(
    packed: Packed,
    pose: Array,
    points: Array,
    normals: Array,
    offsets: Array,
    antennas: NDArray[np.int64],
    rounds: NDArray[np.int64],
    hits: NDArray[np.int64],
    nll: Array,
    gradient: Array,
    information: Array,
) -> None:
    for k in range(len(antennas)):
        x, y, c, s, _, _ = _placed(packed, antennas[k], pose, offsets[k])
        for t in range(len(points)):
            z, by_p, by_q, _ = _of_tag(packed, antennas[k], x, y, c, s, points[t], normals[t])
            e, g, f, _, _ = _terms(packed, z, hits[k, t], rounds[k])
            nll[t] += e
            gx, gy = c * by_p - s * by_q, s * by_p + c * by_q
            gradient[t, 0] += g * gx
            gradient[t, 1] += g * gy
            information[t, 0, 0] += f * gx * gx
            information[t, 0, 1] += f * gx * gy
            information[t, 1, 0] += f * gx * gy
            information[t, 1, 1] += f * gy * gy


@numba.njit(cache=True)
def _probabilities(packed: Packed, antenna: int, poses: Array, points: Array, normals: Array, out: Array) -> None:
    none = np.zeros(3)
    for n in range(len(poses)):
        x, y, c, s, _, _ = _placed(packed, antenna, poses[n], none)
        for t in range(len(points)):
            z, _, _, _ = _of_tag(packed, antenna, x, y, c, s, points[t], normals[t])
            out[n, t] = packed.false_read + packed.span / (1.0 + math.exp(-max(z, NEGLIGIBLE_LOGIT)))
