"""Likelihood of RFID reads for poses that may be anywhere, of detection models that no tables of places stand for.

As :mod:`factors.rfid.anywhere`, for models that use the facing of tags or that have no tables at all (logistic ones), and where
tables of places would be too large: what is in reach of a pose is looked up, or computed, for each antenna by itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.rfid.anywhere import Antennas, mixed
from factors.rfid.index import TagIndex, cells
from factors.rfid.kernels import FAST
from factors.rfid.tables import row_of
from factors.se2 import Array, Integers


class Looked(NamedTuple):
    """Looks of K antennas: which they are, ``rounds`` (K,), and ``hits`` (K, W) of the W tags that are listed; ``number`` (T,):
    which of these a tag of the index is, -1 for others. Log-odds ``odds`` (W,) and ``elsewhere`` (W,) of those, and the odds of the
    ``others``, as in :mod:`factors.rfid.tag_states`."""

    antennas: Integers
    rounds: Integers
    hits: Integers
    number: NDArray[np.int32]
    odds: Array
    elsewhere: Array
    others: float


@compiled(error_model="numpy", fastmath=FAST)
def log_likelihood(
    poses: Array,
    index: TagIndex,
    points: Array,
    normals: Array,
    levels: Integers,
    model: Antennas,
    looked: Looked,
    tempering: float,
    out: Array,
) -> None:
    """Add to ``out`` (N,) the tempered log-likelihood, above that of a silence out of reach, of poses (N, 3). ``points`` (T, 3),
    ``normals`` (T, 2) and ``levels`` (A, T): of tags in the order of the index."""
    packed, looks = model.packed, len(looked.antennas)
    count = (len(index.start) - 1) // index.columns
    far = np.zeros(looked.hits.shape[1])
    base = 0.0
    for w in range(len(far)):
        own = 0.0
        for k in range(looks):
            none = model.logs[packed.which[looked.antennas[k]], 0]
            own += looked.hits[k, w] * np.float64(none[0] - none[1])
        far[w] = mixed(tempering * own, looked.odds[w], looked.elsewhere[w])
        base += far[w]
    at = np.empty((looks, 4))
    for n in range(len(poses)):
        px, py, c, s = poses[n, 0], poses[n, 1], math.cos(poses[n, 2]), math.sin(poses[n, 2])
        for k in range(looks):
            i = looked.antennas[k]
            x, y, ca, sa = packed.antennas[i, 0], packed.antennas[i, 1], packed.antennas[i, 3], packed.antennas[i, 4]
            at[k, 0], at[k, 1] = px + c * x - s * y, py + s * x + c * y
            at[k, 2], at[k, 3] = c * ca - s * sa, s * ca + c * sa
        total = base
        first_x, last_x = cells(index, px - model.reach, px + model.reach, 0, index.columns)
        first_y, last_y = cells(index, py - model.reach, py + model.reach, 1, count)
        for line in range(first_y, last_y + 1):
            if last_x < first_x:
                continue
            begin, end = index.start[line * index.columns + first_x], index.start[line * index.columns + last_x + 1]
            for t in range(begin, end):
                ex, ey = points[t, 0] - px, points[t, 1] - py
                if ex * ex + ey * ey >= model.reach * model.reach:
                    continue
                w = looked.number[t]
                own = 0.0
                for k in range(looks):
                    antenna = looked.antennas[k]
                    x, y = points[t, 0] - at[k, 0], points[t, 1] - at[k, 1]
                    along, across = at[k, 2] * x + at[k, 3] * y, at[k, 2] * y - at[k, 3] * x
                    facing = -(normals[t, 0] * x + normals[t, 1] * y) / math.sqrt(x * x + y * y + 1e-9)
                    row = _row(model, antenna, along, across, points[t, 2], facing, levels[antenna, t])
                    if row == 0 and w < 0:
                        continue
                    m = packed.which[antenna]
                    hits, missed = looked.hits[k, w] if w >= 0 else 0, np.float64(model.logs[m, row, 1])
                    own += looked.rounds[k] * (missed - np.float64(model.logs[m, 0, 1]))
                    own += hits * (np.float64(model.logs[m, row, 0]) - missed)
                if w < 0:
                    total += mixed(tempering * own, looked.others, 0.0)
                else:
                    total += mixed(tempering * own, looked.odds[w], looked.elsewhere[w]) - far[w]
        out[n] += total


@compiled(inline="always")
def _row(model: Antennas, antenna: int, along: float, across: float, height: float, facing: float, level: int) -> int:
    """The row of the tables of logarithms for a tag, placed along and across the antenna's heading, with its height and facing."""
    m = model.packed.which[antenna]
    if along * along + across * across >= model.packed.reach[m] ** 2:
        return 0
    unit = 1.0 / model.packed.scale[m]
    return row_of(model.packed, model.tables, antenna, level, unit * along, unit * across, height, facing)
