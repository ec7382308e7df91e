"""Expected information of RFID antennas along a path, for planning: simulated reads and their likelihood for particles.

All antennas of a robot measure from one pose, so a table holds the result of all antennas for each tag position in the robot
frame, and a tag is looked up once. Only reads need the individual antennas, and they are few: log p(z | x) = sum of log(1 - q) over
all tags in range + sum of logit(q) over the reads. Both are relative to the floor of false reads, so that tags out of range
contribute nothing. False reads of tags out of range are not simulated, nor are walls.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.interfaces import Array32, Places
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factors.compiled import compiled
from factors.rfid.counts import TagReadCounts
from factors.rfid.detection import RfidLikelihood
from factors.rfid.kernels import FAST, detection, of_tag, placed
from factors.rfid.model import Packed
from factors.se2 import Array

CELL = 0.15  # m, of the tables
FACINGS = 24  # directions of tags
LEVEL = 0.25  # m; tags within this height range share a table
NOTHING = 1e-3  # a tag is out of range if no antenna exceeds the probability of a false read by this
MOST_LOOKS = 1 << 16  # per path; a stride of random numbers, so that paths of all lengths share them
ALMOST_NEVER = 1e-12  # minimum probability of a read


class ScanTables(NamedTuple):
    """The response of A antennas to a tag in a cell of the robot frame: layers F (facings of the tag, the last for an unknown or
    irrelevant one) of N x N cells for each of L heights.

    ``read`` (L F N N, A): probability. ``gain`` (A, L F N N): its logit, and ``missed`` (L F N N): sum over antennas of log(1 - q),
    both relative to the floor, and zero at the edge. ``silent`` (L F N N): the absolute sum, but zero at the edge. ``size``: N.
    ``points`` (T, 2) [m], ``facing`` (T,) [rad], NaN if unknown, and ``first`` (T,): first cell of each tag's tables; ``layers``:
    F.
    """

    read: Array
    gain: Array32
    missed: Array32
    silent: Array
    size: int
    layers: int
    points: Array
    facing: Array
    first: Places


def make_tables(likelihood: RfidLikelihood) -> ScanTables:
    """The tables of a model with a map of tags."""
    model, tags = likelihood.model, likelihood.tags
    reach = max((model.models[a.model].reach + math.hypot(a.x, a.y) for a in model.antennas), default=0.0)
    half = math.ceil(reach / CELL)
    levels, level = np.unique(np.rint(tags.points[:, 2] / LEVEL).astype(np.int64), return_inverse=True)
    layers = FACINGS + 1 if any(m.uses_facing for m in model.models) else 1
    q: Array = np.empty((len(levels), layers, 2 * half + 1, 2 * half + 1, len(model.antennas)))
    _fill(model.packed(), np.asarray(levels * LEVEL, dtype=float), half, q)
    floor = max(model.false_read, ALMOST_NEVER)
    q = np.clip(q, floor, 1.0 - ALMOST_NEVER)
    told = np.argwhere((q > floor + NOTHING).any(axis=(0, 1, 4)))
    edge = 1 + (int(np.abs(told - half).max()) if len(told) else 0)
    q = np.pad(q, ((0, 0), (0, 0), (1, 1), (1, 1), (0, 0)))
    q = q[:, :, half + 1 - edge : half + 2 + edge, half + 1 - edge : half + 2 + edge]
    inner = np.zeros((1, 1, *q.shape[2:4], 1), dtype=bool)
    inner[:, :, 1:-1, 1:-1] = True
    q = np.where(inner, q, floor)
    log_missed = np.log1p(-q)
    missed = log_missed - math.log1p(-floor)
    size = q.shape[2]
    return ScanTables(
        read=q.reshape(-1, q.shape[-1]),
        gain=np.ascontiguousarray((np.log(q) - math.log(floor) - missed).astype(np.float32).reshape(-1, q.shape[-1]).T),
        missed=missed.sum(axis=-1).astype(np.float32).ravel(),
        silent=np.where(inner, log_missed, 0.0).sum(axis=-1).ravel(),
        size=size,
        layers=layers,
        points=np.ascontiguousarray(tags.points[:, :2]),
        facing=tags.facing if layers > 1 else np.full(len(tags.facing), np.nan),
        first=(level * layers * size * size).astype(np.int64),
    )


@compiled
def _fill(packed: Packed, heights: Array, half: int, out: Array) -> None:
    levels, layers, size, _, antennas = out.shape
    none = np.zeros(3)
    point, normal = np.zeros(3), np.zeros(2)
    for a in range(antennas):
        x, y, c, s, _, _ = placed(packed, a, none, none)
        for k in range(levels):
            point[2] = heights[k]
            for f in range(layers):
                normal[:] = 0.0
                if f < layers - 1:
                    angle = 2.0 * math.pi * f / (layers - 1)
                    normal[0], normal[1] = math.cos(angle), math.sin(angle)
                for i in range(size):
                    point[0] = (i - half) * CELL
                    for j in range(size):
                        point[1] = (j - half) * CELL
                        z = of_tag(packed, a, x, y, c, s, point, normal)[0]
                        out[k, f, i, j, a] = detection(packed, z, packed.rate[packed.which[a]])[0]


@compiled
def _uniform(seed: np.uint64, number: int) -> float:
    """The random number with this index, the same for all candidates (SplitMix64: Steele, Lea, Flood, OOPSLA 2014)."""
    z = seed + np.uint64(number + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return (z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@compiled
def look_poses(
    particles: Array, along: Array, steps: Places, last: Places, sigmas: Array, normals: Array, out: Array
) -> None:
    """Poses of M particles at S stations of a path, (S, M, 3): the start, the measurement poses and the end.

    ``particles`` (M, 3); ``along`` (P, 3): poses of the path; ``steps`` (S,): indices of the stations; ``last`` (M,): index of the
    last pose that each particle reaches, where it stays; ``sigmas`` (S, 3): motion noise between stations in the robot frame, with
    standard normal draws ``normals`` (S, M, 3).
    """
    count = len(particles)
    errors = np.zeros((count, 3))
    for k in range(len(steps)):
        end = along[steps[k]]
        begin = along[steps[k - 1]] if k else end
        # adjoint of the inverse motion: the earlier error seen from the end
        ce, se = math.cos(end[2]), math.sin(end[2])
        c, s = math.cos(end[2] - begin[2]), math.sin(end[2] - begin[2])
        back_x, back_y = (
            ce * (begin[0] - end[0]) + se * (begin[1] - end[1]),
            ce * (begin[1] - end[1]) - se * (begin[0] - end[0]),
        )
        for i in range(count):
            if k == 0 or steps[k - 1] < last[i]:
                ex, ey, eh = errors[i]
                errors[i, 0] = c * ex + s * ey + back_y * eh + sigmas[k, 0] * normals[k, i, 0]
                errors[i, 1] = c * ey - s * ex - back_x * eh + sigmas[k, 1] * normals[k, i, 1]
                errors[i, 2] = eh + sigmas[k, 2] * normals[k, i, 2]
            at = along[min(steps[k], last[i])]
            ch, sh = math.cos(particles[i, 2]), math.sin(particles[i, 2])
            heading = particles[i, 2] + at[2]
            cn, sn = math.cos(heading), math.sin(heading)
            ex, ey, eh = errors[i]
            out[k, i, 0] = particles[i, 0] + ch * at[0] - sh * at[1] + cn * ex - sn * ey
            out[k, i, 1] = particles[i, 1] + sh * at[0] + ch * at[1] + sn * ex + cn * ey
            out[k, i, 2] = heading + eh


@compiled(error_model="numpy", fastmath=FAST)
def _cells(tables: ScanTables, t: int, poses: Array, turns: Array32, out: NDArray[np.int32]) -> None:
    """The cells in which a tag is seen from poses (M, 3); ``turns`` (2, M): cosine and sine of their headings."""
    size = np.int32(tables.size)
    ends, middle = np.int32(size - 1), np.float32(size // 2 + 0.5)
    first = np.int32(tables.first[t] + (tables.layers - 1) * size * size)
    inverse = 1.0 / CELL
    tx, ty = tables.points[t]
    for i in range(len(poses)):
        ex, ey = np.float32((tx - poses[i, 0]) * inverse), np.float32((ty - poses[i, 1]) * inverse)
        a = np.int32(turns[0, i] * ex + turns[1, i] * ey + middle)
        b = np.int32(turns[0, i] * ey - turns[1, i] * ex + middle)
        a, b = min(max(a, np.int32(0)), ends), min(max(b, np.int32(0)), ends)
        out[i] = first + a * size + b
    if math.isnan(tables.facing[t]):
        return
    angles = tables.layers - 1
    for i in range(len(poses)):
        turn = (tables.facing[t] - poses[i, 2]) / (2.0 * math.pi)
        layer = int((turn - math.floor(turn)) * angles + 0.5) % angles
        out[i] += np.int32((layer - angles) * size * size)


@compiled
def log_weights(
    tables: ScanTables,
    poses: Array,
    rounds: Places,
    stops: Places,
    scans: int,
    seed: np.uint64,
    tempering: float,
    out: Array32,
) -> None:
    """Tempered log-likelihood (J, M) of scans simulated from the first J = ``scans`` particles on one path, for each of M
    particles.

    ``poses`` (S, M, 3): measurement poses; ``rounds`` (S,); ``stops`` (M,): number of measurements of each particle.
    """
    looks, count, _ = poses.shape
    tags = len(tables.points)
    missed = tables.missed
    cells = np.empty((looks, tags, count), np.int32)
    # log-likelihood of no reads at all, cumulated over the measurements
    silence = np.zeros((looks + 1, count), np.float32)
    turns = np.empty((2, count), np.float32)
    for k in range(looks):
        for i in range(count):
            turns[0, i], turns[1, i] = math.cos(poses[k, i, 2]), math.sin(poses[k, i, 2])
        for t in range(tags):
            _cells(tables, t, poses[k], turns, cells[k, t])
            for i in range(count):
                silence[k + 1, i] += missed[np.uint32(cells[k, t, i])]
        for i in range(count):
            silence[k + 1, i] = silence[k, i] + np.float32(rounds[k]) * silence[k + 1, i]
    for n in range(scans):
        for i in range(count):
            out[n, i] = silence[stops[n], i]
    _add_reads(tables, cells, rounds, stops[:scans], seed, out)
    for n in range(scans):
        for i in range(count):
            out[n, i] *= np.float32(tempering)


@compiled
def _add_reads(
    tables: ScanTables, cells: NDArray[np.int32], rounds: Places, stops: Places, seed: np.uint64, out: Array32
) -> None:
    """Draw the reads of each scan, and add their log-likelihood."""
    looks, tags, count = cells.shape
    antennas = tables.read.shape[1]
    gain = tables.gain
    row = np.empty((antennas, count), np.float32)
    filled = np.zeros(antennas, np.bool_)
    for k in range(looks):
        for t in range(tags):
            filled[:] = False
            for n in range(len(stops)):
                cell = cells[k, t, n]
                silent = rounds[k] * tables.silent[cell]
                if k >= stops[n] or silent == 0.0:
                    continue
                left = _uniform(seed, (n * MOST_LOOKS + k) * tags + t)
                # exp(x) is at least 1 + x
                if left < 1.0 + silent or left < math.exp(silent):
                    continue
                for a in range(antennas):
                    hits, left = _binomial(rounds[k], tables.read[cell, a], left)
                    if hits == 0:
                        continue
                    if not filled[a]:
                        for i in range(count):
                            row[a, i] = gain[a, np.uint32(cells[k, t, i])]
                        filled[a] = True
                    for i in range(count):
                        out[n, i] += np.float32(hits) * row[a, i]


@compiled
def _binomial(count: int, q: float, uniform: float) -> tuple[int, float]:
    """Number of ``count`` rounds that read a tag, by inversion, and the rest of the draw, which is uniform again."""
    p = (1.0 - q) ** count
    k = 0
    while uniform >= p and k < count:
        uniform -= p
        p *= (count - k) / (k + 1.0) * q / (1.0 - q)
        k += 1
    return k, min(uniform / p, 1.0)


@compiled
def covariances(poses: Array, index: Places, weights: Array32, out: Array) -> None:
    """Weighted covariances (J, 3, 3) of M particles at stations ``index`` (J,) of ``poses`` (S, M, 3), with ``weights`` (J, M).
    Headings are relative to the first particle's."""
    count = poses.shape[1]
    d = np.empty(3)
    first, second = np.empty(3), np.empty((3, 3))
    for n in range(len(index)):
        first[:], second[:] = 0.0, 0.0
        at = poses[index[n]]
        total = 0.0
        for i in range(count):
            w = weights[n, i]
            if w < 1e-9:
                continue
            d[0], d[1] = at[i, 0] - at[0, 0], at[i, 1] - at[0, 1]
            turn = at[i, 2] - at[0, 2]
            d[2] = turn - 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
            total += w
            for a in range(3):
                first[a] += w * d[a]
                for b in range(a + 1):
                    second[a, b] += w * d[a] * d[b]
        for a in range(3):
            for b in range(a + 1):
                out[n, a, b] = out[n, b, a] = second[a, b] / total - first[a] * first[b] / (total * total)


@compiled
def cell_entropies(poses: Array, index: Places, weights: Array32, cell: Array, dims: int, out: Array) -> None:
    """Entropies (J,) [nats] of histograms of the first ``dims`` coordinates with cells of size ``cell`` (3,); otherwise as
    :func:`covariances`."""
    stations, count, _ = poses.shape
    volume = 0.0
    for a in range(dims):
        volume += math.log(cell[a])
    numbers = np.full((stations, count), -1, np.int64)
    mass = np.zeros(count)
    for n in range(len(index)):
        number = numbers[index[n]]
        if number[0] < 0:
            _number_cells(poses[index[n]], cell, dims, number)
        total = 0.0
        for i in range(count):
            mass[number[i]] += weights[n, i]
            total += weights[n, i]
        entropy = 0.0
        for i in range(count):
            p = mass[i] / total
            if p > 0.0:
                entropy -= p * math.log(p)
            mass[i] = 0.0
        out[n] = entropy + volume


@compiled
def _number_cells(poses: Array, cell: Array, dims: int, out: Places) -> None:
    """Cell indices (M,) below M, equal for particles in one cell: a hash table with open addressing."""
    count = len(poses)
    size = 1
    while size < 4 * count:
        size *= 2
    owner = np.full(size, -1, np.int64)
    keys = np.zeros((count, 3), np.int64)
    for i in range(count):
        for a in range(dims):
            value = poses[i, a]
            if a == 2:
                value -= 2.0 * math.pi * math.floor(value / (2.0 * math.pi))
            keys[i, a] = math.floor(value / cell[a])
        slot = (keys[i, 0] * 73856093 ^ keys[i, 1] * 19349663 ^ keys[i, 2] * 83492791) & (size - 1)
        while owner[slot] >= 0:
            other = keys[owner[slot]]
            if other[0] == keys[i, 0] and other[1] == keys[i, 1] and other[2] == keys[i, 2]:
                break
            slot = (slot + 1) & (size - 1)
        if owner[slot] < 0:
            owner[slot] = i
        out[i] = owner[slot]


ROUNDS_PER_SECOND = 2.0  # default rate


@dataclass(frozen=True, eq=False)
class RfidForecast:
    """A :class:`~factorgraph_loc.sensors.interfaces.Forecast` of inventory rounds, ``rounds_per_metre`` of each antenna."""

    likelihood: RfidLikelihood
    rounds_per_metre: float = 4.0

    @property
    def goals(self) -> Array:
        """The positions of the tags."""
        return self.likelihood.tags.points[:, :2]

    @cached_property
    def _tables(self) -> ScanTables:
        return make_tables(self.likelihood)

    def information(self, poses: Array, ways: Array) -> Array:
        """Expected information, proportional to the number of rounds."""
        count = len(self.likelihood.model.antennas)
        hits = np.zeros((count, len(self.likelihood.tags.points)), dtype=np.int64)
        one_round = TagReadCounts(np.zeros((count, 3)), np.arange(count), np.ones(count, dtype=np.int64), hits)
        found = self.likelihood.score(poses, one_round).information
        return np.asarray((self.rounds_per_metre * ways)[:, None, None] * found)

    def add_log_weights(self, poses: Array, metres: float, stops: Places, seed: np.uint64, out: Array32) -> None:
        """Weigh particles by simulated scans, with the path's rounds distributed over the poses."""
        looks, total = len(poses), round(metres * self.rounds_per_metre)
        rounds = np.diff(np.arange(looks + 1) * total // looks).astype(np.int64)
        found = np.empty_like(out)
        tempering = self.likelihood.model.tempering
        log_weights(self._tables, poses, rounds, stops, len(out), seed, tempering, found)
        out += found


def forecast(world: World, rig: Rig, speed: float, settings: Any = None) -> RfidForecast | None:
    """The forecast for a robot with ``speed`` [m/s], with the rates of a simulation; None without antennas or tags."""
    if rig.find(RfidSettings) is None or not world.tags:
        return None
    rate = ROUNDS_PER_SECOND if settings is None else settings.rounds_per_second
    return RfidForecast(
        RfidLikelihood(rig.of(RfidSettings).model(), tag_map(world, rig.of(SurveySettings)).tags), rate / speed
    )
