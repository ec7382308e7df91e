"""Compiled loops behind :mod:`factors.rfid_likelihood`: each is one pass over poses, antennas and tags."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from factors.rfid import NEGLIGIBLE_LOGIT, Packed, logit
from factors.se2 import Array
from factors.se2_kernels import wrapped

FAST = {"contract", "reassoc", "arcp", "nsz"}  # what an optimiser may do, without taking infinities for impossible


@numba.njit(cache=True)
def moved(offset: Array, offsets: Array) -> Array:
    """The poses (K, 3) that lie ``offset`` (3,) behind ``offsets`` (K, 3)."""
    c, s, out = math.cos(offset[2]), math.sin(offset[2]), np.empty_like(offsets)
    for k in range(len(offsets)):
        out[k, 0] = offset[0] + c * offsets[k, 0] - s * offsets[k, 1]
        out[k, 1] = offset[1] + s * offsets[k, 0] + c * offsets[k, 1]
        out[k, 2] = wrapped(offset[2] + offsets[k, 2])
    return out


@numba.njit(cache=True, inline="always")
def seen(
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


@numba.njit(cache=True, inline="always")
def placed(packed: Packed, antenna: int, pose: Array, offset: Array) -> tuple[float, float, float, float, float, float]:
    """Where an antenna is in the world (x, y, cosine and sine of its heading), for a robot at ``offset`` from ``pose``; and the
    cosine and sine of the robot's heading."""
    c0, s0 = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] + c0 * offset[0] - s0 * offset[1], pose[1] + s0 * offset[0] + c0 * offset[1]
    c, s = math.cos(pose[2] + offset[2]), math.sin(pose[2] + offset[2])
    a = packed.antennas[antenna]
    x, y = x + c * a[0] - s * a[1], y + s * a[0] + c * a[1]
    return x, y, c * a[3] - s * a[4], s * a[3] + c * a[4], c, s


@numba.njit(cache=True, inline="always")
def of_tag(
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
    value, by_p, by_q, _, by_c = seen(packed, antenna, p, q, point[2] - packed.antennas[antenna, 2], facing)
    by_heading = by_p * q - by_q * p
    by_p -= by_c * (nx + facing * p / distance) / distance
    by_q -= by_c * (ny + facing * q / distance) / distance
    return value, by_p, by_q, by_heading


@numba.njit(cache=True, inline="always")
def terms(packed: Packed, z: float, hits: int, rounds: int) -> tuple[float, float, float, float, float]:
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


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def score(
    packed: Packed,
    poses: Array,
    points: Array,
    normals: Array,
    offsets: Array,
    antennas: NDArray[np.int64],
    rounds: NDArray[np.int64],
    hits: NDArray[np.int64],
    tempering: float,
    nll: Array,
    gradient: Array,
    information: Array,
    expected: Array,
    variance: Array,
) -> None:
    for n in range(len(poses)):
        # sums in registers, not in arrays: a scan is one pose, and this loop is most of a smoother's step
        e_sum = mean_sum = spread_sum = 0.0
        g_x = g_y = g_a = 0.0
        xx = xy = xa = yy = ya = aa = 0.0
        for k in range(len(antennas)):
            a = antennas[k]
            x, y, c, s, _, _ = placed(packed, a, poses[n], offsets[k])
            ca, sa = packed.antennas[a, 3], packed.antennas[a, 4]
            lx, ly = packed.antennas[a, 0], packed.antennas[a, 1]
            co, so = math.cos(offsets[k, 2]), math.sin(offsets[k, 2])
            # of the antenna's boresight in the frame of the pose, and the antenna's place there
            cb, sb = co * ca - so * sa, so * ca + co * sa
            px, py = offsets[k, 0] + co * lx - so * ly, offsets[k, 1] + so * lx + co * ly
            far_e, _, _, far_mean, far_spread = terms(packed, NEGLIGIBLE_LOGIT, 0, rounds[k])
            far = 0
            for t in range(len(points)):
                z, by_p, by_q, by_heading = of_tag(packed, a, x, y, c, s, points[t], normals[t])
                if z == NEGLIGIBLE_LOGIT and hits[k, t] == 0:  # out of reach and not read, as most are
                    far += 1
                    continue
                e, g, f, mean, spread = terms(packed, z, hits[k, t], rounds[k])
                e_sum += e
                mean_sum += mean
                spread_sum += spread
                # the antenna moves, the tag does not
                by_x, by_y = sb * by_q - cb * by_p, -sb * by_p - cb * by_q
                by_a = by_heading - by_x * py + by_y * px
                g_x += g * by_x
                g_y += g * by_y
                g_a += g * by_a
                xx += f * by_x * by_x
                xy += f * by_x * by_y
                xa += f * by_x * by_a
                yy += f * by_y * by_y
                ya += f * by_y * by_a
                aa += f * by_a * by_a
            e_sum += far * far_e
            mean_sum += far * far_mean
            spread_sum += far * far_spread
        nll[n], expected[n], variance[n] = tempering * e_sum, tempering * mean_sum, tempering * spread_sum
        gradient[n, 0], gradient[n, 1], gradient[n, 2] = tempering * g_x, tempering * g_y, tempering * g_a
        information[n, 0, 0], information[n, 1, 1], information[n, 2, 2] = (
            tempering * xx,
            tempering * yy,
            tempering * aa,
        )
        information[n, 0, 1] = information[n, 1, 0] = tempering * xy
        information[n, 0, 2] = information[n, 2, 0] = tempering * xa
        information[n, 1, 2] = information[n, 2, 1] = tempering * ya


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
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
            z, by_p, by_q, _ = of_tag(packed, antennas[k], x, y, c, s, points[t], normals[t])
            e, g, f, _, _ = terms(packed, z, hits[k, t], rounds[k])
            nll[t] += e
            gx, gy = c * by_p - s * by_q, s * by_p + c * by_q
            gradient[t, 0] += g * gx
            gradient[t, 1] += g * gy
            information[t, 0, 0] += f * gx * gx
            information[t, 0, 1] += f * gx * gy
            information[t, 1, 0] += f * gx * gy
            information[t, 1, 1] += f * gy * gy


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def probabilities(packed: Packed, antenna: int, poses: Array, points: Array, normals: Array, out: Array) -> None:
    none = np.zeros(3)
    for n in range(len(poses)):
        x, y, c, s, _, _ = placed(packed, antenna, poses[n], none)
        for t in range(len(points)):
            z, _, _, _ = of_tag(packed, antenna, x, y, c, s, points[t], normals[t])
            out[n, t] = packed.false_read + packed.span / (1.0 + math.exp(-max(z, NEGLIGIBLE_LOGIT)))
