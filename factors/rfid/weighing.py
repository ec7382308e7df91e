"""Likelihoods of reads and misses for many poses that are near each other, such as particles, from tables.

Three measures make this fast. The probabilities of all measurements of a tag are multiplied before one logarithm is
taken. The inner loops run over poses, which access nearby cells of a table for one tag. These loops use vector
instructions. Logarithms and exponentials are computed here too: a library would be called pose by pose.
"""

import math

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.rfid.index import Counts, MapTags, NearTags, delayed, near_tags
from factors.rfid.kernels import FAST
from factors.rfid.model import LOGISTIC, NEGLIGIBLE_LOGIT, Packed
from factors.rfid.mounting import reach_of
from factors.rfid.parameters import MOST_CERTAIN, adjusted
from factors.rfid.tables import CELL, NEGLIGIBLE, Measured, Tables, Tags, relevant, row_of
from factors.se2 import Array, Integers

BLOCK = 512  # number of poses that are evaluated together, so that their data stay in the processor's cache
FARTHEST_RATIO = 20.0  # logarithm of the ratio of two likelihoods above which the smaller one is neglected
LEAST = 1e-12  # minimum probability of a read, and of a miss
PRODUCT = 20  # this many factors of at least LEAST have a product that does not underflow
SHIFT = 0.05  # shifts of the logit of a model's peak are rounded to multiples of this
MIXED = 500  # this many factors of at most two have a product that does not overflow

_MANTISSA, _HALF = 0x000FFFFFFFFFFFFF, 0x3FE0000000000000  # bits of a float: mask of the mantissa, and the number 0.5


@compiled(error_model="numpy", fastmath=FAST)
def log_likelihood(
    packed: Packed, tables: Tables, of_map: MapTags, counts: Counts, poses: Array, tempering: float, parameters: Array
) -> Array:
    """Return the tempered log-likelihood (N,) of read ``counts`` at poses (N, 3). ``packed``, ``tables``: models with
    all parameters zero. ``of_map``: the map's tags. ``tempering``: the exponent. ``parameters`` (N or 1, Q): the
    parameters of each pose, or of all poses, see :mod:`factors.rfid.parameters`."""
    first_row = adjusted(packed, parameters[0])
    measured = delayed(counts[0], counts[8], first_row.delay), counts[1], counts[2]
    widest = parameters[0].copy()
    for n in range(1, len(parameters)):
        for i in range(len(widest)):
            widest[i] = max(widest[i], parameters[n, i])
    reach = reach_of(adjusted(packed, widest), measured[0])
    if len(parameters) > 1:
        poses = delayed(poses, counts[8][:1], parameters[:, -1] - parameters[0, -1])
    near = near_tags(of_map, counts, poses, reach)
    tags, odds, elsewhere = tags_of_tables(tables, near), near.odds, near.elsewhere
    near_enough = np.empty(len(odds), np.bool_)
    mark_near(poses, tags, reach, near_enough)
    matters = relevant(first_row, tables, poses, measured, parameters, tags, near_enough, tempering)
    base = tempering * len(of_map.points) * _silence(packed, measured[2])
    none = packed.false_read + packed.span / (1.0 + math.exp(-NEGLIGIBLE_LOGIT))
    for t in range(len(odds)):
        hits = near.hits[:, t].sum()
        if hits > 0 and not near_enough[t]:  # a false read, which is equally likely at all poses
            base += mixed(tempering * hits * (math.log(none) - math.log1p(-none)), odds[t], elsewhere[t])
    out = np.full(len(poses), base)
    size = min(BLOCK, len(poses))
    at, models = np.empty((len(measured[1]), 4, size)), np.empty((len(packed.kinds), 2, size))
    own, product, room, ratios = np.empty(size), np.empty(size), np.empty(size), np.ones(size)
    for first in range(0, len(poses), size):
        count = min(size, len(poses) - first)
        sums = out[first : first + count]
        own_parameters = parameters[first : first + count] if len(parameters) > 1 else parameters
        place_antennas(first_row, poses[first : first + count], measured, own_parameters, parameters[0], at, models)
        factors = 0
        for t in range(len(odds)):
            if not near_enough[t]:
                continue
            weigh_tag(packed, tables, at, models, count, measured, tags, t, matters[:, t], own, product, room)
            if odds[t] == -np.inf or elsewhere[t] == -np.inf:
                for n in range(count):
                    sums[n] += tempering * own[n]
                continue
            displaced = odds[t] + elsewhere[t]
            both = max(odds[t], 0.0) + math.log1p(math.exp(-abs(odds[t])))
            for n in range(count):
                surveyed = tempering * own[n]
                sums[n] += max(surveyed, displaced) - both
                ratios[n] *= 1.0 + fast_exp(-min(abs(surveyed - displaced), FARTHEST_RATIO))
            factors += 1
            if factors == MIXED:
                _add_logs(ratios, count, sums)
                factors = 0
        _add_logs(ratios, count, sums)
    return out


@compiled
def mixed(own: float, odds: float, elsewhere: float) -> float:
    """Return the tempered log-likelihood of a tag that may be weak, moved or dead. It is relative to that of a tag out
    of reach that is never read, like ``own`` and ``elsewhere``. ``own``: the log-likelihood if the tag is as in the
    map. ``elsewhere``: the log-likelihood if it is weak, moved or dead. ``odds``: the prior log-odds of the latter."""
    if odds == -np.inf or elsewhere == -np.inf:
        return own
    displaced = odds + elsewhere
    both = max(odds, 0.0) + math.log1p(math.exp(-abs(odds)))
    if abs(own - displaced) > NEGLIGIBLE:
        return max(own, displaced) - both
    return own + math.log1p(math.exp(displaced - own)) - both


@compiled
def tags_of_tables(tables: Tables, near: NearTags) -> Tags:
    """Return the argument ``tags`` of :func:`weigh_tag`, four arrays about the C tags ``near``. They are points (C, 3),
    normals (C, 2), indices (A, C) of the table of each antenna and tag in ``tables``, and numbers of reads (K, C)."""
    levels = np.empty((len(tables.level), len(near.tags)), np.int64)
    for a in range(len(levels)):
        for u in range(len(near.tags)):
            levels[a, u] = tables.level[a, near.tags[u]]
    return near.points, near.normals, levels, near.hits


@compiled
def mark_near(poses: Array, tags: Tags, reach: float, out: NDArray[np.bool_]) -> None:
    """Write a mask into ``out`` (T,), True for ``tags`` within ``reach`` [m] of the bounding box of poses (N, 3)."""
    points = tags[0]
    low_x = high_x = poses[0, 0]
    low_y = high_y = poses[0, 1]
    for n in range(1, len(poses)):
        low_x, high_x = min(low_x, poses[n, 0]), max(high_x, poses[n, 0])
        low_y, high_y = min(low_y, poses[n, 1]), max(high_y, poses[n, 1])
    for t in range(len(points)):
        x, y = points[t, 0], points[t, 1]
        dx, dy = max(low_x - x, 0.0, x - high_x), max(low_y - y, 0.0, y - high_y)
        out[t] = dx * dx + dy * dy < reach * reach


@compiled(error_model="numpy", fastmath=FAST)
def place_antennas(
    packed: Packed, poses: Array, measured: Measured, parameters: Array, placed: Array, at: Array, models: Array
) -> None:
    """Write the antennas' poses and the models' calibration for N robot poses into arrays.

    ``packed``: models with the parameters ``placed`` (Q,) applied. ``poses`` (N, 3): the robot poses. ``measured``:
    offsets, antennas and rounds of K measurements. ``parameters`` (N or 1, Q): the parameters of each pose, or of all
    poses. Their yaws must not differ from the yaws in ``placed`` by more than 0.5 rad.
    ``at`` (K, 4, N): output, x, y, cosine and sine of the heading of each measurement's antenna in the frame of the
    tags (:mod:`factors.rfid.mounting`).
    ``models`` (M, 2, N): output, the inverse range scale, and rate times span of :class:`~factors.rfid.model.Packed`.
    """
    offsets, antennas, _ = measured
    cosine, sine, yaw = np.empty(len(poses)), np.empty(len(poses)), 2 * len(models)
    for n in range(len(poses)):
        cosine[n], sine[n] = math.cos(poses[n, 2]), math.sin(poses[n, 2])
        row = n if len(parameters) > 1 else 0
        for m in range(len(models)):
            certain = min(packed.peak[m], MOST_CERTAIN)
            shift = SHIFT * np.rint(parameters[row, 2 * m + 1] / SHIFT)
            models[m, 0, n] = math.exp(-parameters[row, 2 * m])
            models[m, 1, n] = packed.span / (certain + (1.0 - certain) * math.exp(-shift))
    for k in range(len(antennas)):
        a, (dx, dy, turn) = packed.antennas[antennas[k]], offsets[k]
        c1, s1 = math.cos(turn), math.sin(turn)
        if not packed.fixed:  # the antenna in the frame of the pose, otherwise the robot
            dx, dy = dx + c1 * a[0] - s1 * a[1], dy + s1 * a[0] + c1 * a[1]
            c1, s1 = c1 * a[3] - s1 * a[4], s1 * a[3] + c1 * a[4]
        x, y, c, s = at[k, 0], at[k, 1], at[k, 2], at[k, 3]
        for n in range(len(poses)):
            x[n], y[n] = poses[n, 0] + cosine[n] * dx - sine[n] * dy, poses[n, 1] + sine[n] * dx + cosine[n] * dy
            c[n], s[n] = cosine[n] * c1 - sine[n] * s1, sine[n] * c1 + cosine[n] * s1
        if packed.fixed:
            for n in range(len(poses)):
                ex, ey = a[0] - x[n], a[1] - y[n]
                x[n], y[n] = c[n] * ex + s[n] * ey, c[n] * ey - s[n] * ex
                c[n], s[n] = c[n] * a[3] + s[n] * a[4], c[n] * a[4] - s[n] * a[3]
        if len(parameters) == len(poses):
            own, reference = yaw + 1 + antennas[k], placed[yaw] + placed[yaw + 1 + antennas[k]]
            for n in range(len(poses)):
                d = parameters[n, yaw] + parameters[n, own] - reference
                c2 = 1.0 - d * d / 2.0 * (1.0 - d * d / 12.0)
                s2 = d * (1.0 - d * d / 6.0 * (1.0 - d * d / 20.0))
                c[n], s[n] = c2 * c[n] - s2 * s[n], s2 * c[n] + c2 * s[n]


@compiled
def _silence(packed: Packed, rounds: Integers) -> float:
    """Return the log-likelihood that a tag out of reach is not read in any of ``rounds`` (K,)."""
    count = 0
    for k in range(len(rounds)):
        count += rounds[k]
    return count * math.log1p(-packed.false_read - packed.span / (1.0 + math.exp(-NEGLIGIBLE_LOGIT)))


@compiled(error_model="numpy", fastmath=FAST)
def weigh_tag(
    packed: Packed,
    tables: Tables,
    at: Array,
    models: Array,
    count: int,
    measured: Measured,
    tags: Tags,
    t: int,
    matters: NDArray[np.bool_],
    own: Array,
    product: Array,
    room: Array,
) -> None:
    """Write the log-likelihood of tag ``t`` at N poses into ``own`` (N,), relative to that of a tag out of reach.

    ``packed``, ``tables``: models. ``at``, ``models``, ``measured``: as in :func:`place_antennas`. ``tags``: from
    :func:`tags_of_tables`. ``count``: N. ``matters`` (K,): mask of measurements to use. ``product``, ``room`` (N,):
    buffers.
    """
    points, normals, levels, hits = tags
    _, antennas, rounds = measured
    silent, factors = -_silence(packed, rounds[matters]), 0
    for n in range(count):
        own[n], product[n] = silent, 1.0
    for k in range(len(antennas)):
        if not matters[k]:
            continue
        level = levels[antennas[k], t]
        model = models[packed.which[antennas[k]]]
        unit, rate = model[0], model[1]
        _chances(packed, tables, at[k], unit, count, antennas[k], level, points[t], normals[t], room)
        for i in range(rounds[k]):
            if i < hits[k, t]:
                for n in range(count):
                    product[n] *= _floored(packed, rate[n], room[n])
            else:
                for n in range(count):
                    product[n] *= 1.0 - _floored(packed, rate[n], room[n])
            factors += 1
            if factors % PRODUCT == 0:
                _add_logs(product, count, own)
    _add_logs(product, count, own)


@compiled(error_model="numpy", fastmath=FAST)
def _chances(
    packed: Packed,
    tables: Tables,
    at: Array,
    unit: Array,
    count: int,
    antenna: int,
    level: int,
    point: Array,
    normal: Array,
    chance: Array,
) -> None:
    """Write the sigmoids of the logits of one tag for one antenna at N poses into ``chance`` (N,). ``at`` (4, N): the
    antenna's poses. ``unit`` (N,): inverse range scales. ``level``: the index of the table in ``tables``. ``count``: N.
    ``point``, ``normal``: position and front of the tag."""
    x, y, c, s = at[0], at[1], at[2], at[3]
    tx, ty, height, nx, ny = point[0], point[1], point[2], normal[0], normal[1]
    if packed.kinds[packed.which[antenna]] == LOGISTIC or tables.facings[level] > 1:
        reach, sigmoids = packed.reach[packed.which[antenna]], tables.sigmoids
        for n in range(count):
            ex, ey = unit[n] * (tx - x[n]), unit[n] * (ty - y[n])
            along, across, squared, row = c[n] * ex + s[n] * ey, c[n] * ey - s[n] * ex, ex * ex + ey * ey, 0
            if squared < reach * reach:
                facing = -(nx * ex + ny * ey) / math.sqrt(squared + 1e-9)
                row = row_of(packed, tables, antenna, level, along, across, height, facing)
            chance[n] = sigmoids[row]
        return
    half = tables.half[level]
    width, ends, middle = np.int32(2 * half + 1), np.int32(2 * half), half + 0.5
    table = tables.chances[tables.start[level] : tables.start[level] + (2 * half + 1) ** 2]
    cells = np.empty(
        count, np.int32
    )  # computed in a separate loop, because the compiler cannot vectorise the access to a table
    for n in range(count):
        scale = unit[n] * (1.0 / CELL)
        ex, ey = scale * (tx - x[n]), scale * (ty - y[n])
        # constant beyond the edge of the table
        i = min(max(np.int32(c[n] * ex + s[n] * ey + middle), np.int32(0)), ends)
        j = min(max(np.int32(c[n] * ey - s[n] * ex + middle), np.int32(0)), ends)
        cells[n] = i * width + j
    for n in range(count):
        chance[n] = table[np.uint32(cells[n])]


@compiled(inline="always")
def _floored(packed: Packed, rate: float, chance: float) -> float:
    """Return the read probability for the sigmoid ``chance``, with false reads, from :data:`LEAST` to 1 -
    :data:`LEAST`. ``rate``: the factor of the probability, from ``models`` of :func:`place_antennas`."""
    return float(min(max(packed.false_read + rate * chance, LEAST), 1.0 - LEAST))


@compiled(fastmath=True)
def _add_logs(values: Array, count: int, out: Array) -> None:
    """Add the logarithms of ``values`` (N,) > 0 to ``out`` (N,), with an error below 1e-10. Sets ``values`` to 1."""
    room = np.empty(count)
    bits, mantissas = values.view(np.int64), room.view(np.int64)
    for n in range(count):
        mantissas[n] = (bits[n] & _MANTISSA) | _HALF
    root = math.sqrt(0.5)
    for n in range(count):
        exponent = np.int32(bits[n] >> 52) - 1022
        s = (room[n] - root) / (room[n] + root)
        z = s * s
        series = 1.0 + z * (1 / 3 + z * (1 / 5 + z * (1 / 7 + z * (1 / 9 + z * (1 / 11)))))
        out[n] += 2.0 * s * series + (exponent - 0.5) * math.log(2.0)
    for n in range(count):
        values[n] = 1.0


@compiled(inline="always")
def fast_exp(x: float) -> float:
    """Return the exponential of x, for x from -20 to 0, with an error of at most 1e-8."""
    y = x / 64.0
    e = 1.0 + y * (
        1.0 + y / 2 * (1.0 + y / 3 * (1.0 + y / 4 * (1.0 + y / 5 * (1.0 + y / 6 * (1.0 + y / 7 * (1.0 + y / 8))))))
    )
    e = e * e * e * e * e * e * e * e
    return float(e * e * e * e * e * e * e * e)
