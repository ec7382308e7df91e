"""Likelihood of RFID reads for poses that may be anywhere in a large map, as those of a search.

For each pose only the tags in its reach are looked at, which a :class:`~factors.rfid.index.TagIndex` tells. Most of them were not
read. What that tells is a function of the tag's place in the robot's frame, the same for all tags of one height; it is tabulated
for all antennas together, as is what a read by each antenna adds, in the cells of :mod:`factors.rfid.tables`. Models that use the
facing of tags have no such tables.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.rfid.index import TagIndex, cells
from factors.rfid.model import LOGISTIC, Packed, RfidModel
from factors.rfid.tables import CELL, NEGLIGIBLE, Tables
from factors.se2 import Array, Integers

MOST = 1 << 25  # numbers in the tables; more have none
NO_MATTER = 1e-3  # of a log-likelihood: a silence that tells less is taken for one out of reach


class Antennas(NamedTuple):
    """A model and its tables. ``logs`` (M, Z, 2): log q and log(1 - q) for the logits of the tables, of each detection model as it
    is adjusted; ``reach`` [m], from the robot's middle."""

    packed: Packed
    tables: Tables
    logs: NDArray[np.float32]
    reach: float


class PlaceTables(NamedTuple):
    """Of H heights: ``gain`` (A, H, S, S), log q - log(1 - q) of each antenna for a tag at a place in the robot's frame, and
    ``missed`` (A, H, S, S), log(1 - q) above that out of reach; ``level`` (T,): height of each tag; ``reach`` [m], from the
    robot's middle; ``none`` (2,): log q and log(1 - q) out of reach."""

    gain: NDArray[np.float32]
    missed: NDArray[np.float32]
    level: Integers
    reach: float
    none: Array


class Heights(NamedTuple):
    """Of the tags of a map: ``columns`` (H, A), tables of all antennas for each height, and ``level`` (T,): height of each tag."""

    columns: Integers
    level: Integers


def heights_of(tables: Tables) -> Heights:
    """The heights that the tables of antennas tell apart."""
    columns, level = np.unique(tables.level.T, axis=0, return_inverse=True)
    return Heights(columns, level.reshape(-1).astype(np.int64))


class TagSilence(NamedTuple):
    """What a tag that nobody reads tells, by its place in the robot's frame: ``untold`` (H, S, S), log-likelihood above that out of
    reach; ``folded`` (H, S, S): the same, tempered, of a tag that may be dead or moved with log-odds ``odds``; ``reach`` [m]."""

    untold: NDArray[np.float32]
    folded: NDArray[np.float32]
    odds: float
    reach: float


class Listed(NamedTuple):
    """The W tags that are in no :class:`TagSilence`: ``number`` (T,), which of them a tag of the index is, -1 for
    others; log-odds ``odds`` (W,) and ``elsewhere`` (W,) as in :mod:`factors.rfid.tag_states`; the reads of tag w are
    ``first[w]`` to ``first[w + 1]`` of ``antennas`` (R,) and ``hits`` (R,); ``far`` (W,): its log-likelihood out of reach."""

    number: NDArray[np.int32]
    odds: Array
    elsewhere: Array
    first: Integers
    antennas: Integers
    hits: Integers
    far: Array


def place_tables(model: RfidModel, antennas: Antennas, heights: Heights) -> PlaceTables | None:
    """The tables of places, from those of the antennas; None where facings matter, for models that have none, and where they would
    be too large."""
    packed, tables, logs, reach = antennas
    used = [packed.kinds[a.model] for a in model.antennas]
    if not tables.level.size or LOGISTIC in used or tables.facings.max() > 1:
        return None
    half = math.ceil(reach / CELL)
    shape = (len(used), len(heights.columns), 2 * half + 1, 2 * half + 1)
    if math.prod(shape) > MOST:
        return None
    gain, missed = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
    q = packed.false_read + packed.span * tables.sigmoids[0]
    none = np.log(np.array((q, 1.0 - q)))
    _fill(packed, tables, logs, heights.columns, half, none, gain, missed)
    return PlaceTables(gain, missed, heights.level, reach, none)


def silence(tables: PlaceTables, antennas: Integers, rounds: Integers, odds: float, tempering: float) -> TagSilence:
    """That of ``rounds`` (K,) of ``antennas`` (K,)."""
    untold: NDArray[np.float32] = np.zeros(tables.missed.shape[1:], dtype=np.float32)
    for antenna, count in zip(antennas.tolist(), rounds.tolist(), strict=True):
        untold += np.float32(count) * tables.missed[antenna]
    own: NDArray[np.float32] = np.float32(tempering) * untold
    folded = own
    if odds > -np.inf:
        folded = (np.logaddexp(own, odds) - np.logaddexp(0.0, odds)).astype(np.float32)
    half = (untold.shape[1] - 1) // 2
    telling = np.argwhere((np.abs(own) > NO_MATTER).any(axis=0)) - half
    reach = CELL * (float(np.max(np.hypot(*telling.T), initial=0.0)) + 1.0)
    return TagSilence(untold, folded, odds, min(reach, tables.reach))


@compiled
def log_likelihood(
    poses: Array,
    index: TagIndex,
    points: Array,
    levels: Integers,
    tables: PlaceTables,
    silent: TagSilence,
    listed: Listed,
    tempering: float,
    out: Array,
) -> None:
    """Add to ``out`` (N,) the tempered log-likelihood, above that of a silence out of reach, of poses (N, 3). ``points`` (T, 2)
    and ``levels`` (T,): of tags in the order of the index."""
    size = silent.folded.shape[1]
    middle = (size - 1) // 2 + 0.5
    count = (len(index.start) - 1) // index.columns
    base = 0.0
    for w in range(len(listed.far)):
        base += listed.far[w]
    reach2, silent2, inverse = tables.reach**2, silent.reach**2, 1.0 / CELL
    for n in range(len(poses)):
        px, py, c, s = poses[n, 0], poses[n, 1], math.cos(poses[n, 2]), math.sin(poses[n, 2])
        total = base
        first_x, last_x = cells(index, px - tables.reach, px + tables.reach, 0, index.columns)
        first_y, last_y = cells(index, py - tables.reach, py + tables.reach, 1, count)
        for y in range(first_y, last_y + 1):
            if last_x < first_x:
                continue
            for k in range(index.start[y * index.columns + first_x], index.start[y * index.columns + last_x + 1]):
                ex, ey = points[k, 0] - px, points[k, 1] - py
                w = listed.number[k]
                if ex * ex + ey * ey >= (silent2 if w < 0 else reach2):
                    continue
                i = min(max(int((c * ex + s * ey) * inverse + middle), 0), size - 1)
                j = min(max(int((c * ey - s * ex) * inverse + middle), 0), size - 1)
                h = levels[k]
                if w < 0:
                    total += silent.folded[h, i, j]
                    continue
                own = np.float64(silent.untold[h, i, j])
                for r in range(listed.first[w], listed.first[w + 1]):
                    own += listed.hits[r] * tables.gain[listed.antennas[r], h, i, j]
                total += mixed(tempering * own, listed.odds[w], listed.elsewhere[w]) - listed.far[w]
        out[n] += total


def far_from(
    tables: PlaceTables, first: Integers, hits: Integers, states: tuple[Array, Array], tempering: float
) -> Array:
    """What each of W tags tells of a pose out of its reach; ``states``: its odds and elsewhere, as in :class:`Listed`."""
    reads = np.add.reduceat(np.append(hits, 0), first[:-1]) * (np.diff(first) > 0) if len(first) > 1 else np.zeros(0)
    out = np.empty(len(reads))
    for w, own in enumerate((tempering * reads * (tables.none[0] - tables.none[1])).tolist()):
        out[w] = mixed(own, states[0][w], states[1][w])
    return out


@compiled
def mixed(own: float, odds: float, elsewhere: float) -> float:
    """Log-likelihood of a tag that may not be where the map has it, ``own`` being that if it is."""
    if odds == -np.inf or elsewhere == -np.inf:
        return own
    other = odds + elsewhere
    both = max(odds, 0.0) + math.log1p(math.exp(-abs(odds)))
    if abs(own - other) > NEGLIGIBLE:
        return max(own, other) - both
    return own + math.log1p(math.exp(other - own)) - both


@compiled
def _fill(
    packed: Packed,
    tables: Tables,
    logs: NDArray[np.float32],
    columns: Integers,
    half: int,
    none: Array,
    gain: NDArray[np.float32],
    missed: NDArray[np.float32],
) -> None:
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
                    log_q, log_p = none
                    if 0 <= along < size and 0 <= across < size:
                        row = tables.rows[tables.start[table] + along * size + across]
                        log_q, log_p = logs[m, row, 0], logs[m, row, 1]
                    gain[a, h, i, j] = log_q - log_p
                    missed[a, h, i, j] = log_p - none[1]
