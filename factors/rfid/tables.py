"""Tables of detection models, to evaluate many poses (particles) without derivatives.

A table has the logits of one detection model in the horizontal plane of the antenna's frame, for tags of one height.
Its cells have the size :data:`CELL`. It has several layers if the model depends on the facing of tags.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.compiled import compiled
from factors.rfid import knots
from factors.rfid.kernels import tag_logit
from factors.rfid.model import (
    GRID,
    LOGISTIC,
    NEAR,
    NEGLIGIBLE_LOGIT,
    Packed,
    RfidModel,
    logistic_value,
)
from factors.rfid.mounting import placed
from factors.rfid.parameters import MOST_CERTAIN
from factors.se2 import Array, Integers

Array32 = NDArray[np.float32]
Measured = tuple[Array, Integers, Integers]  # offsets, antennas and rounds of read counts
Tags = tuple[Array, Array, Integers, Integers]  # points, normals, tables (A, T) and hits (K, T)

CELL = 0.05  # m; size of a cell of a table
COARSE = 8  # number of cells along each side of a block; the largest value of a block is stored
FACINGS = 9  # number of layers, for evenly spaced cosines of the facing from -1 to 1
NEGLIGIBLE = 15.0  # logarithm of the ratio of two likelihoods above which the smaller one is neglected
NO_MATTER = 1e-3  # a tag is neglected if its log-likelihood is closer to that of a tag out of reach
SCATTERED = 2.0  # m; blocks can exclude a tag if its position relative to an antenna differs by less among particles
STEP, LEVEL = 0.01, 0.04  # resolution of logits in the tables, and the height [m] within which tags have one table
_LOGITS = np.arange(round(-2.0 * NEGLIGIBLE_LOGIT / STEP) + 1) * STEP + NEGLIGIBLE_LOGIT


class Tables(NamedTuple):
    """L tables of detection models, stored one after the other. Table l is an array (F, NX, NX) of facings and cells.

    ``sigmoids`` (Z,): the sigmoids of logits that are :data:`STEP` apart, from :data:`NEGLIGIBLE_LOGIT` to its
    negative. ``rows``: the elements of all tables, as indices into ``sigmoids``. ``chances``: ``sigmoids[rows]``.
    ``start`` (L,): the index of the first element of each table.
    ``half`` (L,): the number of cells from the middle of a table to its edge. ``facings`` (L,): F of each table.
    ``level`` (A, T): the number of the table of each antenna and tag.
    ``most``: for each block of :data:`COARSE` by :data:`COARSE` cells, the largest of ``chances`` over all facings.
    ``first`` (L,): the index of the first block of each table in ``most``.
    """

    rows: NDArray[np.uint16]
    chances: Array32
    start: NDArray[np.int64]
    half: NDArray[np.int64]
    facings: NDArray[np.int64]
    level: NDArray[np.int64]
    sigmoids: Array
    most: Array32
    first: NDArray[np.int64]


def logs_of(packed: Packed) -> Array32:
    """Return the logarithms (M, Z, 2) of read and miss probability of M models at the Z logits of :class:`Tables`."""
    q = packed.false_read + packed.span * packed.rate[:, None] / (1.0 + np.exp(-_LOGITS))
    q = np.clip(q, 1e-12, 1.0 - 1e-12)
    return np.asarray(np.log(np.stack((q, 1.0 - q), axis=-1)), dtype=np.float32)


def make_tables(model: RfidModel, packed: Packed, heights: Array) -> Tables:
    """Return tables of a model for tags at ``heights`` (T,) [m]. There is one for each detection model, pitch of the
    antenna, and height of tags above it. ``packed``: the model for compiled code. Logistic models need no table."""
    sigmoids = 1.0 / (1.0 + np.exp(-_LOGITS))
    numbers: dict[tuple[int, float, int], int] = {}
    level = np.zeros((len(model.antennas), len(heights)), dtype=np.int64)
    tables: list[NDArray[np.uint16]] = []
    halves: list[int] = []
    planes: dict[int, Array] = {}
    for i, antenna in enumerate(model.antennas):
        detection = model.models[antenna.model]
        if packed.kinds[antenna.model] == LOGISTIC:
            continue
        steps, which = np.unique(np.rint((heights - antenna.z) / LEVEL).astype(np.int64), return_inverse=True)
        indices = np.zeros(len(steps), dtype=np.int64)
        for j, step in enumerate(steps.tolist()):
            key = (antenna.model, antenna.pitch, step)
            if key not in numbers:
                numbers[key] = len(tables)
                half = math.ceil(detection.reach / CELL)
                table = np.empty((FACINGS if detection.uses_facing else 1, 2 * half + 1, 2 * half + 1), np.uint16)
                if packed.kinds[antenna.model] == GRID and antenna.pitch == 0.0:
                    if antenna.model not in planes:
                        planes[antenna.model] = _planes(packed, antenna.model, table.shape)
                    _fill_level(planes[antenna.model], packed, antenna.model, step * LEVEL, table)
                else:
                    _fill(packed, i, step * LEVEL, half, table)
                tables.append(table)
                halves.append(half)
            indices[j] = numbers[key]
        level[i] = indices[which]
    sizes = np.array([t.size for t in tables], dtype=np.int64)
    rows = np.concatenate([t.ravel() for t in tables]) if tables else np.empty(0, np.uint16)
    blocks = [_blocks(t) for t in tables]
    most = np.concatenate([b.ravel() for b in blocks]) if tables else np.empty(0, np.uint16)
    small = sigmoids.astype(np.float32)
    return Tables(
        rows,
        small[rows],
        np.concatenate((np.zeros(1, np.int64), np.cumsum(sizes)))[: len(tables)],
        np.array(halves, dtype=np.int64),
        np.array([len(t) for t in tables], dtype=np.int64),
        level,
        sigmoids,
        small[most],
        np.cumsum([0, *(b.size for b in blocks)])[: len(tables)].astype(np.int64),
    )


def _blocks(table: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the largest element, over all directions of the tag's front, in each block of a table (F, NX, NX)."""
    begins = np.arange(0, table.shape[1], COARSE)
    highest = np.maximum.reduceat(table.max(axis=0), begins, axis=0)
    return np.asarray(np.maximum.reduceat(highest, begins, axis=1))


@compiled
def logit_row(z: float) -> int:
    """Return the index of the logit ``z`` in ``sigmoids`` of :class:`Tables`."""
    return int((min(max(z, NEGLIGIBLE_LOGIT), -NEGLIGIBLE_LOGIT) - NEGLIGIBLE_LOGIT) / STEP + 0.5)


def _planes(packed: Packed, model: int, shape: tuple[int, ...]) -> Array:
    """Return logits (H, F, NX, NY) of a grid model at its H heights, interpolated at the facings and cells of tables.
    ``shape``: (F, NX, NX) of the tables. ``model``: the index of the grid model."""
    heights, facings, nx, ny, first = packed.shapes[model].tolist()
    x0, y0, cell = packed.parameters[model, :3]
    grid = packed.knots[first : first + heights * facings * nx * ny].reshape(heights, facings, nx, ny)
    at = (np.arange(shape[1]) - shape[1] // 2) * CELL
    by_x, by_y = (knots.matrix(knots.cubic((at - a) / cell, n), n) for a, n in ((x0, nx), (y0, ny)))
    by_facing = knots.matrix(knots.cubic(np.linspace(0.0, facings - 1.0, shape[0]), facings), facings)
    return np.asarray(np.einsum("fk,hkxy->hfxy", by_facing, by_x @ grid @ by_y.T))


def _fill_level(planes: Array, packed: Packed, model: int, height: float, table: NDArray[np.uint16]) -> None:
    """Write a ``table`` of a grid model for an antenna without pitch, like :func:`_fill` but faster. ``planes``: the
    result of :func:`_planes`. ``height`` [m]: the tags' height above the antenna."""
    z0, step = packed.parameters[model, 3:5]
    levels, weights = knots.linear(np.array(((height - z0) / step,)), len(planes))
    z = sum(weight * planes[level] for level, weight in zip(levels[0], weights[0], strict=True) if weight > 0.0)
    np.clip(z, NEGLIGIBLE_LOGIT, -NEGLIGIBLE_LOGIT, out=z)
    z -= NEGLIGIBLE_LOGIT
    z /= STEP
    z += 0.5
    table[:] = z


@compiled
def _fill(packed: Packed, antenna: int, height: float, half: int, table: NDArray[np.uint16]) -> None:
    """Write a ``table`` of any model, for tags at ``height`` [m] above the antenna. ``half``: the number of cells from
    the middle of the table to its edge."""
    facings = len(table)
    for f in range(facings):
        c = 2.0 * f / (facings - 1) - 1.0 if facings > 1 else 0.0
        for i in range(2 * half + 1):
            for j in range(2 * half + 1):
                z = tag_logit(packed, antenna, (i - half) * CELL, (j - half) * CELL, height, c)[0]
                table[f, i, j] = logit_row(z)


@compiled(inline="always")
def row_of(
    packed: Packed, tables: Tables, antenna: int, level: int, along: float, across: float, height: float, facing: float
) -> int:
    """Return the index in ``sigmoids`` of :class:`Tables` for the logit of a tag in reach of an antenna.

    ``level``: the number of the table. ``along``, ``across``: the tag's position along and across the antenna's
    heading, divided by the range scale of the model. ``height`` [m]: the tag's height above the floor. ``facing``: the
    cosine of the angle between the tag's front and the direction to the antenna.
    """
    m = packed.which[antenna]
    if packed.kinds[m] == LOGISTIC:
        above = height - packed.antennas[antenna, 2]
        cp, sp = packed.antennas[antenna, 5], packed.antennas[antenna, 6]
        u, z = cp * along + sp * above, cp * above - sp * along
        r = math.sqrt(u * u + across * across + NEAR * NEAR)
        return logit_row(logistic_value(packed.parameters[m], r, 1.0 - u / r, z, facing))
    half, layers = tables.half[level], tables.facings[level]
    size = 2 * half + 1
    i = min(max(int(along / CELL + half + 0.5), 0), size - 1)
    j = min(max(int(across / CELL + half + 0.5), 0), size - 1)
    place = tables.start[level] + i * size + j
    if layers == 1:
        return int(tables.rows[place])
    f = (facing + 1.0) * 0.5 * (layers - 1)
    below = min(int(f), layers - 2)
    low = np.float64(tables.rows[place + below * size * size])
    high = np.float64(tables.rows[place + (below + 1) * size * size])
    return int(low + (f - below) * (high - low) + 0.5)


@compiled
def relevant(
    packed: Packed,
    tables: Tables,
    poses: Array,
    measured: Measured,
    parameters: Array,
    tags: Tags,
    near: NDArray[np.bool_],
    tempering: float,
) -> NDArray[np.bool_]:
    """Return a mask (K, T), True if a tag in a measurement noticeably changes the likelihood of any particle.

    ``poses`` (N, 3), ``parameters`` (N or 1, Q): poses and parameters of the particles. ``packed``, ``tables``: models
    with the first row of ``parameters`` applied, and their tables. ``near`` (T,): a mask of tags in reach.
    ``measured``: offsets, antennas and rounds of K measurements. ``tags``: points, normals, table numbers and hits of T
    tags. ``tempering``: exponent of the likelihood.

    The mask is True for near tags that were read, and for near tags with a relevant read probability. If the tags are
    on the robot, all are relevant.
    """
    offsets, antennas, rounds = measured
    points, _, levels, hits = tags
    out = np.zeros(hits.shape, np.bool_)
    low_x, high_x, low_y, high_y = poses[:, 0].min(), poses[:, 0].max(), poses[:, 1].min(), poses[:, 1].max()
    middle, turned = np.array((0.5 * (low_x + high_x), 0.5 * (low_y + high_y), poses[0, 2])), 0.0
    for n in range(len(poses)):
        turned = max(turned, abs(se2.wrap_scalar(poses[n, 2] - middle[2])))
    apart = 0.5 * math.hypot(high_x - low_x, high_y - low_y)
    for k in range(len(antennas)):
        m, antenna, yaw = packed.which[antennas[k]], packed.antennas[antennas[k]], 2 * len(packed.reach)
        yaws = parameters[:, yaw] + parameters[:, yaw + 1 + antennas[k]]
        scattered = turned + np.abs(yaws - yaws[0]).max()
        x, y, c, s = placed(packed, antennas[k], middle, offsets[k])
        lever = math.hypot(antenna[0], antenna[1]) + math.hypot(offsets[k, 0], offsets[k, 1])
        small, large = math.exp(-parameters[:, 2 * m].max()), math.exp(-parameters[:, 2 * m].min())
        unit = 0.5 * (small + large)
        least = NO_MATTER * min(packed.peak[m], MOST_CERTAIN) / (tempering * rounds[k] * packed.span)
        for t in range(len(near)):
            if hits[k, t] > 0 or packed.kinds[m] == LOGISTIC or packed.fixed:
                out[k, t] = near[t]
            elif near[t]:
                ex, ey = points[t, 0] - x, points[t, 1] - y
                distance = math.hypot(ex, ey)
                radius = large * (apart + (lever + distance) * scattered) + (large - unit) * distance
                along, across = unit * (c * ex + s * ey), unit * (c * ey - s * ex)
                level = levels[antennas[k], t]
                out[k, t] = radius > SCATTERED or _largest(tables, level, along, across, radius) > least
    return out


@compiled
def _largest(tables: Tables, level: int, along: float, across: float, radius: float) -> float:
    """Return an upper bound of the sigmoids of the table ``level`` within ``radius`` [m] of the position (``along``,
    ``across``). Beyond its edge a table continues with the values at the edge."""
    half, largest = tables.half[level], 0.0
    last, reach = 2 * half, radius / CELL + 1.0
    i, j, count = along / CELL + half, across / CELL + half, 2 * half // COARSE + 1
    for a in range(_block(i - reach, last), _block(i + reach, last) + 1):
        for b in range(_block(j - reach, last), _block(j + reach, last) + 1):
            largest = max(largest, tables.most[tables.first[level] + a * count + b])
    return float(largest)


@compiled(inline="always")
def _block(place: float, last: int) -> int:
    """Return the number of the block that contains the cell ``place``, clipped to the range from 0 to ``last``."""
    return int(min(max(place, 0.0), last)) // COARSE
