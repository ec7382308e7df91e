"""Predicts the information of RFID antennas along candidate paths, for planning.

Reads are simulated, and their likelihood is evaluated for particles. Let q be the probability that an antenna reads a
tag. The log-likelihood is the sum of log(1 - q) over all tags and antennas, plus the sum of logit(q) over all reads.
The first sum is read from a table, which contains the sum over all antennas for each position of a tag in the robot
frame. The second sum has few terms. Tags out of range, and walls, are ignored.
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
from factors.rfid.detection import RfidLikelihood, TagReadCounts
from factors.rfid.kernels import FAST
from factors.se2 import Array

COARSE = 3  # size of cells and of height steps, as a multiple of those in the tables of the antennas
FACINGS = 24  # number of possible facings of a tag, evenly spaced
UNREAD = 1e-3  # a tag is out of range if no read probability exceeds that of a false read by more than this
MOST_LOOKS = 1 << 16  # maximum number of rounds on a path


class ScanTables(NamedTuple):
    """Read probabilities of A antennas, tabulated by the pose of a tag in the robot frame, and a map of T tags.

    The pose has C cells: H heights x F facings x S x S positions. The last facing is for tags with an unknown facing.
    ``read`` (C, A): the probability q of a read. ``gain`` (A, C): log(q / (1 - q)). ``missed`` (C,): the sum of
    log(1 - q) over antennas, minus that sum for a tag out of range. ``silent`` (C,): the sum of log(1 - q), 0 if out of
    range. ``size``: S. ``layers``: F. ``cell``: the size of a cell [m]. ``points`` (T, 2) [m]: positions of the tags.
    ``facing`` (T,) [rad]: their facings, NaN if unknown. ``first`` (T,): the first cell of the height of each tag.
    """

    read: Array32
    gain: Array32
    missed: Array32
    silent: Array
    size: int
    layers: int
    cell: float
    points: Array
    facing: Array
    first: Places


def make_tables(likelihood: RfidLikelihood) -> ScanTables:
    """Return the tables of the detection model and of the map of tags in ``likelihood``."""
    tables, tags = likelihood.robot_tables(COARSE, FACINGS), likelihood.tags
    antennas, _, layers, size, _ = tables.gain.shape
    gain, missed = tables.gain.reshape(antennas, -1), tables.missed.sum(axis=0).ravel()
    read = (1.0 / (1.0 + np.exp(-gain))).T.astype(np.float32, order="C")
    in_range = (read > np.exp(tables.none[:, 0]) + UNREAD).any(axis=1)
    silent = np.where(in_range, missed + tables.none[:, 1].sum(), 0.0)
    points, first = np.ascontiguousarray(tags.points[:, :2]), tables.level * layers * size * size
    return ScanTables(read, gain, missed, silent, size, layers, tables.cell, points, tags.facing, first)


@compiled
def _uniform(seed: np.uint64, number: int) -> float:
    """Return the uniform random number with the index ``number`` in the sequence of ``seed``. Source (SplitMix64):
    Steele, Lea, Flood, OOPSLA 2014."""
    z = seed + np.uint64(number + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return (z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@compiled(error_model="numpy", fastmath=FAST)
def _cells(tables: ScanTables, t: int, poses: Array, turns: Array32, out: NDArray[np.int32]) -> None:
    """Write the index of the cell of :class:`ScanTables` that contains tag ``t``, at each robot pose in ``poses`` (M,
    3), to ``out`` (M,). ``turns`` (2, M): cosines and sines of the robot's headings."""
    size = np.int32(tables.size)
    ends, middle = np.int32(size - 1), np.float32(size // 2 + 0.5)
    first = np.int32(tables.first[t] + (tables.layers - 1) * size * size)
    inverse = 1.0 / tables.cell
    tx, ty = tables.points[t]
    for i in range(len(poses)):
        ex, ey = np.float32((tx - poses[i, 0]) * inverse), np.float32((ty - poses[i, 1]) * inverse)
        a = np.int32(turns[0, i] * ex + turns[1, i] * ey + middle)
        b = np.int32(turns[0, i] * ey - turns[1, i] * ex + middle)
        a, b = min(max(a, np.int32(0)), ends), min(max(b, np.int32(0)), ends)
        out[i] = first + a * size + b
    angles = tables.layers - 1
    if angles == 0 or math.isnan(tables.facing[t]):
        return
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
    """Simulate the reads of J = ``scans`` of M particles on a path, and write their log-likelihoods for all M to
    ``out``.

    ``out`` (J, M): row j receives the log-likelihood of each particle for the reads of particle j. ``tables``: the read
    probabilities and the tags. ``poses`` (S, M, 3): the pose of each particle at S points of the path. ``rounds`` (S,):
    the number of rounds at each point. ``stops`` (M,): the number of points that each particle reaches. ``seed``: the
    seed of random numbers. ``tempering``: the exponent of the likelihood.
    """
    steps, count, _ = poses.shape
    tags = len(tables.points)
    missed = tables.missed
    cells = np.empty((steps, tags, count), np.int32)
    # log-likelihood of no reads at the first k stations
    silence = np.zeros((steps + 1, count), np.float32)
    turns = np.empty((2, count), np.float32)
    for k in range(steps):
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
    """Draw random reads, and add their log-likelihoods to ``out``, before tempering. ``cells`` (S, T, M): the cell
    index of each tag at each pose. For other arguments see :func:`log_weights`."""
    steps, tags, count = cells.shape
    antennas = tables.read.shape[1]
    gain = tables.gain
    row = np.empty((antennas, count), np.float32)
    filled = np.zeros(antennas, np.bool_)
    for k in range(steps):
        for t in range(tags):
            filled[:] = False
            for n in range(len(stops)):
                cell = cells[k, t, n]
                silent = rounds[k] * tables.silent[cell]
                if k >= stops[n] or silent == 0.0:
                    continue
                left = _uniform(seed, (n * MOST_LOOKS + k) * tags + t)
                # exp(x) >= 1 + x, so that the first test avoids most calls of exp
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
    """Return a binomial random number for ``count`` trials with probability ``q``, by inversion of the uniform random
    number ``uniform``. Also return a new uniform random number, which is independent of the result."""
    p = (1.0 - q) ** count
    k = 0
    while uniform >= p and k < count:
        uniform -= p
        p *= (count - k) / (k + 1.0) * q / (1.0 - q)
        k += 1
    return k, min(uniform / p, 1.0)


@dataclass(frozen=True, eq=False)
class RfidForecast:
    """Predicts the information of RFID reads on candidate paths. It implements
    :class:`~factorgraph_loc.sensors.interfaces.Forecast`. ``rounds_per_metre``: inventory rounds of each antenna per
    metre."""

    likelihood: RfidLikelihood
    rounds_per_metre: float = 4.0

    @property
    def goals(self) -> Array:
        """The positions (T, 2) of the tags [m]."""
        return self.likelihood.tags.points[:, :2]

    @cached_property
    def _tables(self) -> ScanTables:
        return make_tables(self.likelihood)

    def information(self, poses: Array, ways: Array) -> Array:
        """Return the expected Fisher information (N, 3, 3) of reads on each of the ``poses`` (N, 3) of a path. ``ways``
        (N,): the length [m] of the path segment of each pose. The number of rounds is proportional to it."""
        count = len(self.likelihood.model.antennas)
        hits = np.zeros((count, len(self.likelihood.tags.points)), dtype=np.int64)
        one_round = TagReadCounts(np.zeros((count, 3)), np.arange(count), np.ones(count, dtype=np.int64), hits)
        score = self.likelihood.score(poses, one_round).information
        return np.asarray((self.rounds_per_metre * ways)[:, None, None] * score)

    def add_log_weights(self, poses: Array, metres: float, stops: Places, seed: np.uint64, out: Array32) -> None:
        """Simulate reads from the first J of M particles, and add their log-likelihoods for all particles to ``out``
        (J, M). ``poses`` (S, M, 3): the particles at S points of a path of length ``metres`` [m]. Other arguments: see
        :meth:`~factorgraph_loc.sensors.interfaces.Forecast.add_log_weights`."""
        steps, total = len(poses), round(metres * self.rounds_per_metre)
        rounds = np.diff(np.arange(steps + 1) * total // steps).astype(np.int64)
        added = np.empty_like(out)
        tempering = self.likelihood.model.tempering
        log_weights(self._tables, poses, rounds, stops, len(out), seed, tempering, added)
        out += added


def forecast(world: World, rig: Rig, speed: float, settings: Any) -> RfidForecast | None:
    """Return the forecast of RFID reads for a robot that drives at ``speed`` [m/s], or None without antennas or tags.
    ``settings``: settings of the simulation, which include the number of rounds per second."""
    if rig.find(RfidSettings) is None or not world.tags:
        return None
    likelihood = RfidLikelihood(rig.of(RfidSettings).model(), tag_map(world, rig.of(SurveySettings)).tags)
    return RfidForecast(likelihood, settings.rounds_per_second / speed)
