"""The exact likelihood of reads and misses of RFID tags, with derivatives: compiled loops over poses, tags and antennas.

An antenna reads a tag in k of n inventory rounds with probability q each (:mod:`factors.rfid.model`), so the negative
log-likelihood is ``-sum(k log q + (n - k) log(1 - q))``. Its Hessian is replaced by the Fisher information, which is positive
semi-definite. Derivatives are by the body-frame perturbation of the pose, by parameters of the detection models, and by the
position of a tag.

Two parameters of each detection model describe what differs between installations (power, cables, kinds of tags). With ``a``, the
logarithm of a factor of the range, and ``b``, a shift of the logit of the largest read probability ``peak``, the model's
``p(x, y, z)`` of a tag in the antenna's frame becomes

    rate * p(x / scale, y / scale, z),    scale = exp(a),    rate = sigmoid(logit(peak) + b) / peak,

which for a beam is another ``r_max`` (with its ``s_r`` in proportion) and another ``p0``. The parameters of M models are a vector
(2 M,): ``a`` and ``b`` of the first model, then of the second. With zeros the model is as it was.
"""

import math

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.rfid.index import MapTags, Seen, moved, near_tags
from factors.rfid.model import NEGLIGIBLE_LOGIT, Packed, logit
from factors.se2 import Array, Integers

FAST = {"contract", "reassoc", "arcp", "nsz"}  # fast-math flags that keep infinities
PARAMETERS = ("range_scale", "read_rate")  # of each detection model
MOST_CERTAIN = 0.99  # limit of the peak of a model: a larger one would leave the rate nothing to change
ROW = 8  # numbers of each row of placed antennas


@compiled
def rate_of(peak: float, shift: float) -> float:
    """The factor of the probabilities of a model with largest probability ``peak``, whose logit shifts by ``shift``."""
    certain = min(peak, MOST_CERTAIN)
    return float(1.0 / (certain + (1.0 - certain) * math.exp(-shift)))


@compiled
def adjusted(packed: Packed, parameters: Array) -> Packed:
    """The models with these parameters (2 M,); ``packed``: the models without adjustment."""
    models = len(packed.reach)
    scale, reach, rate = np.empty(models), np.empty(models), np.empty(models)
    for m in range(models):
        scale[m] = math.exp(parameters[2 * m])
        reach[m] = packed.reach[m] * scale[m]
        rate[m] = rate_of(packed.peak[m], parameters[2 * m + 1])
    return Packed(
        packed.antennas,
        packed.which,
        packed.kinds,
        packed.parameters,
        packed.shapes,
        packed.knots,
        reach,
        packed.false_read,
        packed.span,
        scale,
        rate,
        packed.peak,
    )


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


@compiled
def reach_of(packed: Packed, offsets: Array) -> float:
    """How far [m] the antennas reach at most from the pose that measurements at ``offsets`` (K, 3) are relative to."""
    way = farthest = 0.0
    for k in range(len(offsets)):
        way = max(way, math.hypot(offsets[k, 0], offsets[k, 1]))
    for a in range(len(packed.which)):
        lever = math.hypot(packed.antennas[a, 0], packed.antennas[a, 1])
        farthest = max(farthest, packed.reach[packed.which[a]] + lever)
    return way + farthest


@compiled(inline="always")
def _place_antennas(packed: Packed, pose: Array, offsets: Array, antennas: NDArray[np.int64], out: Array) -> float:
    """Fill ``out`` (K, 8): position and boresight of each antenna in the world, then both in the frame of the pose.

    Returns how far from the pose [m] the antennas reach.
    """
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
def mixture(
    odds: float, elsewhere: float, e: float, mean: float, spread: float, none: float, tempering: float
) -> tuple[float, float, float, float]:
    """The factor of the derivatives of a tag that may be dead or moved (:mod:`factors.rfid.tag_states`), and its tempered negative
    log-likelihood with mean and variance.

    ``e``, ``mean`` and ``spread``: the same, untempered, of a tag as surveyed; ``none``: the negative log-likelihood of misses
    out of range. Reads of a tag that is not as surveyed are as likely as expected. The derivatives neglect the information lost by
    the unknown state (Louis, JRSS B 44(2), 1982, eq. 3.2').
    """
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


@compiled(inline="always")
def outcome(q: float, hits: int, rounds: int) -> tuple[float, float, float, float, float]:
    """Negative log-likelihood of k hits in n rounds with probability q, its derivative by q, Fisher's information on q, and mean
    and variance of the negative log-likelihood."""
    log_q, log_p = math.log(q), math.log1p(-q)
    nll = -(hits * log_q + (rounds - hits) * log_p)
    gradient = -(hits / q - (rounds - hits) / (1.0 - q))
    information = rounds / (q * (1.0 - q))
    expected = -rounds * (q * log_q + (1.0 - q) * log_p)
    variance = rounds * q * (1.0 - q) * (log_q - log_p) ** 2
    return nll, gradient, information, expected, variance


@compiled(inline="always")
def _unread(packed: Packed, rounds: int) -> tuple[float, float, float]:
    """Negative log-likelihood of misses of a tag out of range, its mean and variance."""
    nll, _, _, expected, variance = outcome(detection(packed, NEGLIGIBLE_LOGIT, 1.0)[0], 0, rounds)
    return nll, expected, variance


@compiled(inline="always")
def _add_tag(
    packed: Packed,
    at: Array,
    antennas: Integers,
    rounds: Integers,
    hits: Integers,
    point: Array,
    normal: Array,
    far: Array,
    columns: Integers,
    by: Array,
    slope: Array,
    curve: Array,
) -> tuple[float, float, float]:
    """Negative log-likelihood of one tag as surveyed in all measurements, its mean and variance over all outcomes.

    The gradient ``slope`` (D,) and the lower triangle of the information ``curve`` (D, D) are filled: by the pose, then by the
    parameters that have a column, then by the tag's position in the world if D leaves room for it. ``far`` (K, 3): what a miss out
    of range contributes; ``by`` (D,) is work space.
    """
    size, estimated = len(slope), 0
    for i in range(len(columns)):
        estimated += columns[i] >= 0
    slope[:], curve[:] = 0.0, 0.0
    nll = mean = variance = 0.0
    for k in range(len(antennas)):
        x, y, c, s = at[k, 0], at[k, 1], at[k, 2], at[k, 3]
        z, by_p, by_q, by_heading, by_range = of_tag(packed, antennas[k], x, y, c, s, point, normal)
        if z == NEGLIGIBLE_LOGIT and hits[k] == 0:  # out of reach and not read, as most are
            nll, mean, variance = nll + far[k, 0], mean + far[k, 1], variance + far[k, 2]
            continue
        m = packed.which[antennas[k]]
        rate = packed.rate[m]
        q, by_z, by_rate = detection(packed, z, rate)
        e, gradient, information, expected, spread = outcome(q, hits[k], rounds[k])
        nll, mean, variance = nll + e, mean + expected, variance + spread
        # the antenna moves, the tag does not
        by[0] = by_z * (at[k, 5] * by_q - at[k, 4] * by_p)
        by[1] = -by_z * (at[k, 5] * by_p + at[k, 4] * by_q)
        by[2] = by_z * by_heading - by[0] * at[k, 7] + by[1] * at[k, 6]
        if estimated > 0:
            by[3:] = 0.0
            if columns[2 * m] >= 0:
                by[columns[2 * m]] = by_z * by_range
            if columns[2 * m + 1] >= 0:
                by[columns[2 * m + 1]] = by_rate * (1.0 - rate * min(packed.peak[m], MOST_CERTAIN))
        if size > 3 + estimated:
            by[size - 2], by[size - 1] = by_z * (c * by_p - s * by_q), by_z * (s * by_p + c * by_q)
        for i in range(size):
            slope[i] += gradient * by[i]
            for j in range(i + 1):
                curve[i, j] += information * by[i] * by[j]
    return nll, mean, variance


@compiled(error_model="numpy", fastmath=FAST)
def scores(
    packed: Packed, of_map: MapTags, seen: Seen, tempering: float, poses: Array, columns: Integers
) -> tuple[Array, Array, Array, Array, Array]:
    """The fields of a :class:`~factors.rfid.detection.Score` of poses (N, 3) for adjusted models. ``columns`` (2 M,): of the
    parameters of the detection models in the derivatives, -1 for those that have none."""
    offsets, antennas, rounds = seen[:3]
    count, looks, size = len(poses), len(antennas), 3
    for i in range(len(columns)):
        size += columns[i] >= 0
    near = near_tags(of_map, seen, poses, reach_of(packed, offsets))
    hits, tags = near.hits, len(near.tags)
    heard = np.zeros(tags, np.int64)
    far, none, none_mean, none_variance = np.empty((looks, 3)), 0.0, 0.0, 0.0
    for k in range(looks):
        far[k, 0], far[k, 1], far[k, 2] = _unread(packed, rounds[k])
        none, none_mean, none_variance = none + far[k, 0], none_mean + far[k, 1], none_variance + far[k, 2]
        for t in range(tags):
            heard[t] += hits[k, t]
    nll, expected, variance = np.empty(count), np.empty(count), np.empty(count)
    gradient, information = np.zeros((count, size)), np.zeros((count, size, size))
    at, by, slope, curve = np.empty((looks, ROW)), np.empty(size), np.empty(size), np.empty((size, size))
    for n in range(count):
        farthest = _place_antennas(packed, poses[n], offsets, antennas, at)
        # tags that are not listed are out of reach and not read
        beyond = len(of_map.points) - tags
        e_sum = mean_sum = variance_sum = 0.0
        for t in range(tags):
            dx, dy = near.points[t, 0] - poses[n, 0], near.points[t, 1] - poses[n, 1]
            if heard[t] == 0 and dx * dx + dy * dy >= farthest * farthest:
                beyond += 1
                continue
            e, mean, spread = _add_tag(
                packed,
                at,
                antennas,
                rounds,
                hits[:, t],
                near.points[t],
                near.normals[t],
                far,
                columns,
                by,
                slope,
                curve,
            )
            share, e, mean, spread = mixture(near.odds[t], near.elsewhere[t], e, mean, spread, none, tempering)
            e_sum, mean_sum, variance_sum = e_sum + e, mean_sum + mean, variance_sum + spread
            for i in range(size):
                gradient[n, i] += share * slope[i]
                for j in range(i + 1):
                    information[n, i, j] += share * curve[i, j]
        nll[n] = e_sum + tempering * beyond * none
        expected[n] = mean_sum + tempering * beyond * none_mean
        variance[n] = variance_sum + tempering * beyond * none_variance
        for i in range(size):
            for j in range(i):
                information[n, j, i] = information[n, i, j]
    return nll, gradient, information, expected, variance


@compiled
def score(
    packed: Packed, of_map: MapTags, seen: Seen, tempering: float, pose: Array, parameters: Array, estimated: Integers
) -> tuple[float, Array, Array, float, float]:
    """Of one pose (3,) and models without adjustment, with ``parameters`` (2 M,): negative log-likelihood; its gradient (3 + P,)
    and information (3 + P, 3 + P) by the pose and the ``estimated`` (P,) parameters; mean and variance."""
    columns = np.full(len(parameters), -1, np.int64)
    for i in range(len(estimated)):
        columns[estimated[i]] = 3 + i
    poses = pose.copy().reshape(1, 3)
    found = scores(adjusted(packed, parameters), of_map, seen, tempering, poses, columns)
    return found[0][0], found[1][0], found[2][0], found[3][0], found[4][0]


@compiled(error_model="numpy", fastmath=FAST)
def by_tag(
    packed: Packed,
    pose: Array,
    points: Array,
    normals: Array,
    offsets: Array,
    antennas: Integers,
    rounds: Integers,
    hits: Integers,
) -> tuple[Array, Array, Array]:
    """Of each of T tags as surveyed, at one pose (3,): negative log-likelihood (T,); gradient (T, 5) and information (T, 5, 5) by
    the pose and by the tag's position in the world."""
    looks, tags, size = len(antennas), len(points), 5
    nll, gradient, information = np.empty(tags), np.empty((tags, size)), np.empty((tags, size, size))
    at, far, by = np.empty((looks, ROW)), np.empty((looks, 3)), np.empty(size)
    columns = np.full(2 * len(packed.reach), -1, np.int64)
    _place_antennas(packed, pose, offsets, antennas, at)
    for k in range(looks):
        far[k, 0], far[k, 1], far[k, 2] = _unread(packed, rounds[k])
    for t in range(tags):
        slope, curve = gradient[t], information[t]
        nll[t] = _add_tag(
            packed, at, antennas, rounds, hits[:, t], points[t], normals[t], far, columns, by, slope, curve
        )[0]
        for i in range(size):
            for j in range(i):
                curve[j, i] = curve[i, j]
    return nll, gradient, information


@compiled(error_model="numpy", fastmath=FAST)
def probabilities(
    packed: Packed, antennas: Integers, poses: Array, points: Array, normals: Array
) -> tuple[Array, Array]:
    """Probability (N, T), floor included, that a round of ``antennas`` (N,) on a robot at ``poses`` (N, 3) reads each tag, and the
    distance (N, T) [m] in the plane from the antenna."""
    none = np.zeros(3)
    p, distance = np.empty((len(poses), len(points))), np.empty((len(poses), len(points)))
    for n in range(len(poses)):
        x, y, c, s, _, _ = placed(packed, antennas[n], poses[n], none)
        rate = packed.rate[packed.which[antennas[n]]]
        for t in range(len(points)):
            z = of_tag(packed, antennas[n], x, y, c, s, points[t], normals[t])[0]
            p[n, t] = detection(packed, z, rate)[0]
            distance[n, t] = math.hypot(points[t, 0] - x, points[t, 1] - y)
    return p, distance


@compiled
def predicted(
    packed: Packed, of_map: MapTags, seen: Seen, pose: Array, parameters: Array
) -> tuple[Integers, Integers, Array, Array]:
    """With ``parameters`` (2 M,) of models without adjustment, of the tags near a pose (3,) or listed: their indices in the map
    (C,), and for each measurement the hits, the probability of a read and the distance [m] from the antenna, (K, C)."""
    offsets, antennas = seen[:2]
    own = adjusted(packed, parameters)
    near = near_tags(of_map, seen, pose.copy().reshape(1, 3), reach_of(own, offsets))
    p, distance = probabilities(own, antennas, moved(pose, offsets), near.points, near.normals)
    return near.tags, near.hits, p, distance
