"""Which looks of antennas at tags tell anything of poses that are near each other, as particles: in a dense map most do not."""

import math

import numpy as np
from numpy.typing import NDArray

from factors import se2_kernels
from factors.compiled import compiled
from factors.rfid.kernels import MOST_CERTAIN, placed
from factors.rfid.model import LOGISTIC, Packed
from factors.rfid.tables import CELL, COARSE, Tables
from factors.se2 import Array, Integers

NO_MATTER = 1e-3  # of a log-likelihood: a silence that tells less is taken for one out of reach
SCATTERED = 2.0  # m: what may lie anywhere in so wide a circle is looked up pose by pose

Looks = tuple[Array, Integers, Integers]  # offsets, antennas and rounds of read counts
Tags = tuple[Array, Array, Integers, Integers]  # points, normals, tables (A, T) and hits (K, T)


@compiled
def telling(
    packed: Packed,
    tables: Tables,
    poses: Array,
    looks: Looks,
    parameters: Array,
    tags: Tags,
    near: NDArray[np.bool_],
    tempering: float,
) -> NDArray[np.bool_]:
    """Which looks at which tags (K, T) tell something of some of the poses (N, 3) with ``parameters`` (N or 1, 2 M): those at tags
    that are ``near`` (T,), and were read or, as blocks of the tables tell, might have been."""
    offsets, antennas, rounds = looks
    points, _, levels, hits = tags
    out = np.zeros(hits.shape, np.bool_)
    low_x, high_x, low_y, high_y = poses[:, 0].min(), poses[:, 0].max(), poses[:, 1].min(), poses[:, 1].max()
    middle, turned = np.array((0.5 * (low_x + high_x), 0.5 * (low_y + high_y), poses[0, 2])), 0.0
    for n in range(len(poses)):
        turned = max(turned, abs(se2_kernels.wrapped(poses[n, 2] - middle[2])))
    apart = 0.5 * math.hypot(high_x - low_x, high_y - low_y)
    for k in range(len(antennas)):
        m, antenna = packed.which[antennas[k]], packed.antennas[antennas[k]]
        x, y, c, s, _, _ = placed(packed, antennas[k], middle, offsets[k])
        lever = math.hypot(antenna[0], antenna[1]) + math.hypot(offsets[k, 0], offsets[k, 1])
        small, large = math.exp(-parameters[:, 2 * m].max()), math.exp(-parameters[:, 2 * m].min())
        unit = 0.5 * (small + large)
        least = NO_MATTER * min(packed.peak[m], MOST_CERTAIN) / (tempering * rounds[k] * packed.span)
        for t in range(len(near)):
            if hits[k, t] > 0 or packed.kinds[m] == LOGISTIC:
                out[k, t] = near[t]
            elif near[t]:
                ex, ey = points[t, 0] - x, points[t, 1] - y
                distance = math.hypot(ex, ey)
                radius = large * (apart + (lever + distance) * turned) + (large - unit) * distance
                along, across = unit * (c * ex + s * ey), unit * (c * ey - s * ex)
                level = levels[antennas[k], t]
                out[k, t] = radius > SCATTERED or _largest(tables, level, along, across, radius) > least
    return out


@compiled
def _largest(tables: Tables, level: int, along: float, across: float, radius: float) -> float:
    """A bound of the chances of a table in a circle; beyond its edge they are as at the edge."""
    half, largest = tables.half[level], 0.0
    last, reach = 2 * half, radius / CELL + 1.0
    i, j, count = along / CELL + half, across / CELL + half, 2 * half // COARSE + 1
    for a in range(_block(i - reach, last), _block(i + reach, last) + 1):
        for b in range(_block(j - reach, last), _block(j + reach, last) + 1):
            largest = max(largest, tables.most[tables.first[level] + a * count + b])
    return float(largest)


@compiled(inline="always")
def _block(place: float, last: int) -> int:
    return int(min(max(place, 0.0), last)) // COARSE
