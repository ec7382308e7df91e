"""Compiled loops of :mod:`factors.rfid.detection`, over poses, antennas and tags."""

import math

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.rfid.model import NEGLIGIBLE_LOGIT, Packed, logit
from factors.se2 import Array
from factors.se2_kernels import wrapped

FAST = {"contract", "reassoc", "arcp", "nsz"}  # fast-math flags that keep infinities


@compiled
def moved(offset: Array, offsets: Array) -> Array:
    """The poses (K, 3) ``offset`` (3,) composed with ``offsets`` (K, 3)."""
    c, s, out = math.cos(offset[2]), math.sin(offset[2]), np.empty_like(offsets)
    for k in range(len(offsets)):
        out[k, 0] = offset[0] + c * offsets[k, 0] - s * offsets[k, 1]
        out[k, 1] = offset[1] + s * offsets[k, 0] + c * offsets[k, 1]
        out[k, 2] = wrapped(offset[2] + offsets[k, 2])
    return out


@compiled(inline="always")
def seen(
    packed: Packed, antenna: int, p: float, q: float, height: float, c: float
) -> tuple[float, float, float, float, float]:
    """Logit of a tag at (p, q, height) from the antenna, in axes rotated by its yaw only, and derivatives by p, q, height, c."""
    cp, sp = packed.antennas[antenna, 5], packed.antennas[antenna, 6]
    m = packed.which[antenna]
    x, z = cp * p + sp * height, cp * height - sp * p
    value, by_x, by_y, by_z, by_c = logit(
        packed.kinds[m], packed.parameters[m], packed.shapes[m], packed.knots, x, q, z, c
    )
    return value, cp * by_x - sp * by_z, by_y, sp * by_x + cp * by_z, by_c


@compiled(inline="always")
def placed(packed: Packed, antenna: int, pose: Array, offset: Array) -> tuple[float, float, float, float, float, float]:
    """The antenna's x, y, cosine and sine of its heading in the world, for a robot at ``offset`` from ``pose``; and the cosine and
    sine of the robot's heading."""
    c0, s0 = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] + c0 * offset[0] - s0 * offset[1], pose[1] + s0 * offset[0] + c0 * offset[1]
    c, s = math.cos(pose[2] + offset[2]), math.sin(pose[2] + offset[2])
    a = packed.antennas[antenna]
    x, y = x + c * a[0] - s * a[1], y + s * a[0] + c * a[1]
    return x, y, c * a[3] - s * a[4], s * a[3] + c * a[4], c, s


@compiled(inline="always")
def of_tag(
    packed: Packed, antenna: int, x: float, y: float, c: float, s: float, point: Array, normal: Array
) -> tuple[float, float, float, float, float]:
    """Logit of one tag for an antenna at (x, y) that looks along (c, s), and its derivatives: by the tag's place along and across
    the boresight, by the antenna's heading, and by the logarithm of the model's range. Beyond the reach it is constant."""
    ex, ey = point[0] - x, point[1] - y
    m = packed.which[antenna]
    squared = ex * ex + ey * ey
    if squared >= packed.reach[m] ** 2:
        return NEGLIGIBLE_LOGIT, 0.0, 0.0, 0.0, 0.0
    p, q = c * ex + s * ey, c * ey - s * ex
    nx, ny = c * normal[0] + s * normal[1], c * normal[1] - s * normal[0]
    distance = math.sqrt(squared + 1e-9)
    facing = -(nx * p + ny * q) / distance
    unit = 1.0 / packed.scale[m]
    height = point[2] - packed.antennas[antenna, 2]
    value, by_p, by_q, _, by_c = seen(packed, antenna, unit * p, unit * q, height, facing)
    by_p, by_q = unit * by_p, unit * by_q
    by_range = -(by_p * p + by_q * q)
    by_heading = by_p * q - by_q * p
    by_p -= by_c * (nx + facing * p / distance) / distance
    by_q -= by_c * (ny + facing * q / distance) / distance
    return value, by_p, by_q, by_heading, by_range


@compiled(inline="always")
def detection(packed: Packed, z: float, rate: float) -> tuple[float, float, float]:
    """Probability of a read at a logit, floor included, and its derivatives by the logit and by the logarithm of ``rate``."""
    sigmoid = 1.0 / (1.0 + math.exp(-max(z, NEGLIGIBLE_LOGIT)))
    by_rate = packed.span * rate * sigmoid
    # a model without a floor may be certain, and certainty has no logarithm
    q = min(max(packed.false_read + by_rate, 1e-12), 1.0 - 1e-12)
    return q, by_rate * (1.0 - sigmoid), by_rate


@compiled(inline="always")
def terms(packed: Packed, z: float, rate: float, hits: int, rounds: int) -> tuple[float, float, float, float, float]:
    """Negative log-likelihood of k hits in n rounds, its derivative by the logit, Fisher's information on the logit, and mean and
    variance of the negative log-likelihood."""
    q, by_z, _ = detection(packed, z, rate)
    log_q, log_p = math.log(q), math.log1p(-q)
    nll = -(hits * log_q + (rounds - hits) * log_p)
    gradient = -(hits / q - (rounds - hits) / (1.0 - q)) * by_z
    information = rounds * by_z * by_z / (q * (1.0 - q))
    expected = -rounds * (q * log_q + (1.0 - q) * log_p)
    variance = rounds * q * (1.0 - q) * (log_q - log_p) ** 2
    return nll, gradient, information, expected, variance


@compiled(inline="always")
def place_looks(packed: Packed, pose: Array, offsets: Array, antennas: NDArray[np.int64], out: Array) -> float:
    """Rows (K, 8) of looks: place and boresight of the antenna in the world, then in the frame of the pose. Returns how far from
    the pose [m] the farthest antenna reaches."""
    farthest = 0.0
    for k in range(len(antennas)):
        a = packed.antennas[antennas[k]]
        out[k, 0], out[k, 1], out[k, 2], out[k, 3], _, _ = placed(packed, antennas[k], pose, offsets[k])
        co, so = math.cos(offsets[k, 2]), math.sin(offsets[k, 2])
        out[k, 4], out[k, 5] = co * a[3] - so * a[4], so * a[3] + co * a[4]
        out[k, 6], out[k, 7] = offsets[k, 0] + co * a[0] - so * a[1], offsets[k, 1] + so * a[0] + co * a[1]
        reach = packed.reach[packed.which[antennas[k]]]
        farthest = max(farthest, math.sqrt(out[k, 6] ** 2 + out[k, 7] ** 2) + reach)
    return farthest


@compiled(inline="always")
def _surveyed(
    packed: Packed,
    at: Array,
    antennas: NDArray[np.int64],
    rounds: NDArray[np.int64],
    hits: NDArray[np.int64],
    point: Array,
    normal: Array,
    far: Array,
) -> tuple[float, float, float, tuple[float, float, float], tuple[float, float, float, float, float, float]]:
    """For one tag as surveyed, over all measurements: negative log-likelihood, its mean and variance over all outcomes; gradient,
    and information (upper triangle)."""
    e_sum = mean_sum = spread_sum = 0.0
    g_x = g_y = g_a = 0.0
    xx = xy = xa = yy = ya = aa = 0.0
    for k in range(len(antennas)):
        x, y, c, s = at[k, 0], at[k, 1], at[k, 2], at[k, 3]
        z, by_p, by_q, by_heading, _ = of_tag(packed, antennas[k], x, y, c, s, point, normal)
        if z == NEGLIGIBLE_LOGIT and hits[k] == 0:  # out of reach and not read, as most are
            e_sum, mean_sum, spread_sum = e_sum + far[k, 0], mean_sum + far[k, 1], spread_sum + far[k, 2]
            continue
        rate = packed.rate[packed.which[antennas[k]]]
        e, g, f, mean, spread = terms(packed, z, rate, hits[k], rounds[k])
        e_sum += e
        mean_sum += mean
        spread_sum += spread
        # the antenna moves, the tag does not
        by_x, by_y = at[k, 5] * by_q - at[k, 4] * by_p, -at[k, 5] * by_p - at[k, 4] * by_q
        by_a = by_heading - by_x * at[k, 7] + by_y * at[k, 6]
        g_x += g * by_x
        g_y += g * by_y
        g_a += g * by_a
        xx += f * by_x * by_x
        xy += f * by_x * by_y
        xa += f * by_x * by_a
        yy += f * by_y * by_y
        ya += f * by_y * by_a
        aa += f * by_a * by_a
    return e_sum, mean_sum, spread_sum, (g_x, g_y, g_a), (xx, xy, xa, yy, ya, aa)


@compiled(inline="always")
def counted(
    odds: float, elsewhere: float, e: float, mean: float, spread: float, none: float, tempering: float
) -> tuple[float, float, float, float]:
    """How much a tag counts that may not be where the map has it (:mod:`factors.rfid.tag_states`): the factor of its derivatives,
    and its tempered negative log-likelihood with mean and variance. ``e``, ``mean`` and ``spread``: the same, untempered, of a tag
    as surveyed; ``none``: that of a silence out of range. What a tag tells that is not as surveyed is never a surprise."""
    if odds == -np.inf or elsewhere == -np.inf:
        return tempering, tempering * e, tempering * mean, tempering * spread
    surveyed, other = tempering * (none - e), odds + elsewhere
    most = max(surveyed, other)
    own = math.exp(surveyed - most)
    total = own + math.exp(other - most)
    nll = tempering * none - most - math.log(total) + max(odds, 0.0) + math.log1p(math.exp(-abs(odds)))
    usual = 1.0 / (1.0 + math.exp(odds))
    expected = usual * tempering * mean + (1.0 - usual) * (tempering * none - elsewhere)
    return tempering * own / total, nll, expected, usual * tempering * spread


@compiled(error_model="numpy", fastmath=FAST)
def score(
    packed: Packed,
    poses: Array,
    points: Array,
    normals: Array,
    offsets: Array,
    antennas: NDArray[np.int64],
    rounds: NDArray[np.int64],
    hits: NDArray[np.int64],
    odds: Array,
    elsewhere: Array,
    tempering: float,
    nll: Array,
    gradient: Array,
    information: Array,
    expected: Array,
    variance: Array,
) -> None:
    looks, tags = hits.shape
    heard = np.zeros(tags, np.int64)
    for k in range(looks):
        for t in range(tags):
            heard[t] += hits[k, t]
    # contribution of a tag that is out of range of all antennas
    far = np.empty((looks, 3))
    far_e = far_mean = far_spread = 0.0
    for k in range(looks):
        far[k, 0], _, _, far[k, 1], far[k, 2] = terms(packed, NEGLIGIBLE_LOGIT, 1.0, 0, rounds[k])
        far_e, far_mean, far_spread = far_e + far[k, 0], far_mean + far[k, 1], far_spread + far[k, 2]
    at = np.empty((looks, 8))
    for n in range(len(poses)):
        # sums in local variables, for speed: this loop dominates a smoother's update
        e_sum = mean_sum = spread_sum = 0.0
        g_x = g_y = g_a = 0.0
        xx = xy = xa = yy = ya = aa = 0.0
        farthest = place_looks(packed, poses[n], offsets, antennas, at)
        beyond = 0
        for t in range(tags):
            dx, dy = points[t, 0] - poses[n, 0], points[t, 1] - poses[n, 1]
            if heard[t] == 0 and dx * dx + dy * dy >= farthest * farthest:
                beyond += 1
                continue
            tag_e, tag_mean, tag_spread, slope, curve = _surveyed(
                packed, at, antennas, rounds, hits[:, t], points[t], normals[t], far
            )
            share, e, mean, spread = counted(odds[t], elsewhere[t], tag_e, tag_mean, tag_spread, far_e, tempering)
            e_sum, mean_sum, spread_sum = e_sum + e, mean_sum + mean, spread_sum + spread
            g_x, g_y, g_a = g_x + share * slope[0], g_y + share * slope[1], g_a + share * slope[2]
            xx, xy, xa = xx + share * curve[0], xy + share * curve[1], xa + share * curve[2]
            yy, ya, aa = yy + share * curve[3], ya + share * curve[4], aa + share * curve[5]
        nll[n] = e_sum + tempering * beyond * far_e
        expected[n] = mean_sum + tempering * beyond * far_mean
        variance[n] = spread_sum + tempering * beyond * far_spread
        gradient[n, 0], gradient[n, 1], gradient[n, 2] = g_x, g_y, g_a
        information[n, 0, 0], information[n, 1, 1], information[n, 2, 2] = xx, yy, aa
        information[n, 0, 1] = information[n, 1, 0] = xy
        information[n, 0, 2] = information[n, 2, 0] = xa
        information[n, 1, 2] = information[n, 2, 1] = ya


@compiled(error_model="numpy", fastmath=FAST)
def by_tag(
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
        x, y, c, s, _, _ = placed(packed, antennas[k], pose, offsets[k])
        for t in range(len(points)):
            z, by_p, by_q, _, _ = of_tag(packed, antennas[k], x, y, c, s, points[t], normals[t])
            e, g, f, _, _ = terms(packed, z, packed.rate[packed.which[antennas[k]]], hits[k, t], rounds[k])
            nll[t] += e
            gx, gy = c * by_p - s * by_q, s * by_p + c * by_q
            gradient[t, 0] += g * gx
            gradient[t, 1] += g * gy
            information[t, 0, 0] += f * gx * gx
            information[t, 0, 1] += f * gx * gy
            information[t, 1, 0] += f * gx * gy
            information[t, 1, 1] += f * gy * gy


@compiled(error_model="numpy", fastmath=FAST)
def probabilities(packed: Packed, antenna: int, poses: Array, points: Array, normals: Array, out: Array) -> None:
    none = np.zeros(3)
    for n in range(len(poses)):
        x, y, c, s, _, _ = placed(packed, antenna, poses[n], none)
        for t in range(len(points)):
            z = of_tag(packed, antenna, x, y, c, s, points[t], normals[t])[0]
            out[n, t] = detection(packed, z, packed.rate[packed.which[antenna]])[0]
