"""The exact likelihood of reads and misses of RFID tags, with derivatives: compiled loops over poses, tags and antennas.

An antenna reads a tag in k of n inventory rounds with probability q each (:mod:`factors.rfid.model`), so the negative
log-likelihood is ``-sum(k log q + (n - k) log(1 - q))``. Its Hessian is replaced by the Fisher information, which is positive
semi-definite. Derivatives are by the body-frame perturbation of the pose, by the parameters of the likelihood
(:mod:`factors.rfid.parameters`), and by the position of a tag. A tag is "as surveyed" if it works and is where the map has it.
"""

import math

import numpy as np

from factors.compiled import compiled
from factors.rfid.index import Counts, MapTags, delayed, moved, near_tags
from factors.rfid.model import NEGLIGIBLE_LOGIT, Packed, logit
from factors.rfid.mounting import place_measurements, placed, reach_of
from factors.rfid.parameters import MOST_CERTAIN, adjusted
from factors.se2 import Array, Integers

FAST = {"contract", "reassoc", "arcp", "nsz"}  # fast-math flags that keep infinities
ROW = 8  # numbers per antenna in the result of `place_measurements`
OF_READ, PLACE = 5, 7  # numbers of derivatives of one read probability, without and with the two by the tag's position
MOST_COLUMNS = 8  # largest number of components of pose and parameters that one measurement depends on


@compiled(inline="always")
def tag_logit(
    packed: Packed, antenna: int, p: float, q: float, height: float, c: float
) -> tuple[float, float, float, float, float]:
    """Return the logit of the read probability of a tag at (p, q, height) [m] from one ``antenna`` of the models
    ``packed``. Also returns its derivatives by p, q, height and c. The axes have the antenna's yaw but no pitch. ``c``:
    the cosine of the angle between the tag's front and the direction to the antenna."""
    cp, sp = packed.antennas[antenna, 5], packed.antennas[antenna, 6]
    m = packed.which[antenna]
    x, z = cp * p + sp * height, cp * height - sp * p
    value, by_x, by_y, by_z, by_c = logit(
        packed.kinds[m], packed.parameters[m], packed.shapes[m], packed.knots, x, q, z, c
    )
    return value, cp * by_x - sp * by_z, by_y, sp * by_x + cp * by_z, by_c


@compiled(inline="always")
def of_tag(
    packed: Packed, antenna: int, x: float, y: float, c: float, s: float, point: Array, normal: Array
) -> tuple[float, float, float, float, float]:
    """Return the logit of the read probability of one tag, and four derivatives: by the tag's position along and across
    the boresight, by the antenna's heading, and by the logarithm of the model's range. (``x``, ``y``), (``c``, ``s``):
    position and horizontal boresight of the antenna. ``point`` (3,), ``normal`` (2,): position and front of the tag."""
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
    value, by_p, by_q, _, by_c = tag_logit(packed, antenna, unit * p, unit * q, height, facing)
    by_p, by_q = unit * by_p, unit * by_q
    by_range = -(by_p * p + by_q * q)
    by_heading = by_p * q - by_q * p
    by_p -= by_c * (nx + facing * p / distance) / distance
    by_q -= by_c * (ny + facing * q / distance) / distance
    return value, by_p, by_q, by_heading, by_range


@compiled(inline="always")
def detection(packed: Packed, z: float, rate: float) -> tuple[float, float, float]:
    """Return the read probability, including false reads, at the logit ``z``. Also returns its derivatives by the logit
    and by the logarithm of ``rate``, a factor of the probability. ``packed``: has the probability of false reads."""
    sigmoid = 1.0 / (1.0 + math.exp(-max(z, NEGLIGIBLE_LOGIT)))
    by_rate = packed.span * rate * sigmoid
    # without false reads, a probability p may be 0 or 1, so that log(p) or log(1 - p) is infinite
    q = min(max(packed.false_read + by_rate, 1e-12), 1.0 - 1e-12)
    return q, by_rate * (1.0 - sigmoid), by_rate


@compiled(inline="always")
def mixture(
    odds: float, elsewhere: float, e: float, mean: float, variance: float, none: float, tempering: float
) -> tuple[float, float, float, float]:
    """Return four values about a tag that may be weak (seldom read), moved or dead. The first is a factor to multiply
    the derivatives of ``e`` by. The others are the tempered negative log-likelihood, its mean, and its variance.

    ``odds``: the prior log-odds that the tag is weak, moved or dead. ``elsewhere``: the tempered log-likelihood of its
    reads if it is, minus that of a tag out of reach that is never read. ``e``, ``mean``, ``variance``: the untempered
    negative log-likelihood of a tag that is as in the map, and its mean and variance over all outcomes.
    ``none``: the untempered negative log-likelihood that a tag out of reach is never read. ``tempering``: the exponent.

    The loss of information by the unknown state (Louis, JRSS B 44(2), 1982) is neglected.
    """
    if odds == -np.inf or elsewhere == -np.inf:
        return tempering, tempering * e, tempering * mean, tempering * variance
    surveyed, displaced = tempering * (none - e), odds + elsewhere
    most = max(surveyed, displaced)
    own = math.exp(surveyed - most)
    total = own + math.exp(displaced - most)
    nll = tempering * none - most - math.log(total) + max(odds, 0.0) + math.log1p(math.exp(-abs(odds)))
    usual = 1.0 / (1.0 + math.exp(odds))
    expected = usual * tempering * mean + (1.0 - usual) * (tempering * none - elsewhere)
    return tempering * own / total, nll, expected, usual * tempering * variance


@compiled(inline="always")
def outcome(q: float, hits: int, rounds: int) -> tuple[float, float, float, float, float]:
    """Return five numbers about ``hits`` reads in ``rounds`` rounds with read probability ``q``. The first is the
    negative log-likelihood. The others are its derivative by q, its Fisher information, and its mean and variance over
    all numbers of reads."""
    log_q, log_p = math.log(q), math.log1p(-q)
    nll = -(hits * log_q + (rounds - hits) * log_p)
    gradient = -(hits / q - (rounds - hits) / (1.0 - q))
    information = rounds / (q * (1.0 - q))
    expected = -rounds * (q * log_q + (1.0 - q) * log_p)
    variance = rounds * q * (1.0 - q) * (log_q - log_p) ** 2
    return nll, gradient, information, expected, variance


@compiled
def _unread(packed: Packed, rounds: Integers) -> Array:
    """Return three values for each of K measurements (K, 3): the negative log-likelihood that a tag out of range is not
    read, and the mean and variance of the negative log-likelihood over all outcomes. ``rounds`` (K,): their rounds."""
    out, q = np.empty((len(rounds), 3)), detection(packed, NEGLIGIBLE_LOGIT, 1.0)[0]
    for k in range(len(rounds)):
        out[k, 0], _, _, out[k, 1], out[k, 2] = outcome(q, 0, rounds[k])
    return out


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
    by: Array,
    slope: Array,
    curve: Array,
) -> tuple[float, float, float]:
    """Return the negative log-likelihood of a tag that is as in the map, in K measurements, and its mean and variance.

    Writes, for each measurement, the derivative ``slope`` (K,) by the read probability and the Fisher information
    ``curve`` (K,) on that probability, both 0 out of reach. Writes the derivatives ``by`` (K, 7) of the read
    probability by the antenna's position in the frame of the pose (2), its yaw, the parameters ``a`` and ``b`` of its
    model, and the tag's position in the world (2). ``at`` (K, 8): poses of the antennas, from
    :func:`place_measurements`. ``far`` (K, 3): the values of a tag out of reach, from :func:`_unread`.
    """
    nll = mean = variance = 0.0
    for k in range(len(antennas)):
        x, y, c, s = at[k, 0], at[k, 1], at[k, 2], at[k, 3]
        z, by_p, by_q, by_heading, by_range = of_tag(packed, antennas[k], x, y, c, s, point, normal)
        if z == NEGLIGIBLE_LOGIT and hits[k] == 0:  # most tags are out of reach and not read
            nll, mean, variance = nll + far[k, 0], mean + far[k, 1], variance + far[k, 2]
            slope[k] = curve[k] = 0.0
            continue
        m = packed.which[antennas[k]]
        rate = packed.rate[m]
        q, by_z, by_rate = detection(packed, z, rate)
        e, slope[k], curve[k], expected, own_variance = outcome(q, hits[k], rounds[k])
        nll, mean, variance = nll + e, mean + expected, variance + own_variance
        # a motion of the antenna has the opposite effect of the same motion of the tag
        by[k, 0] = by_z * (at[k, 5] * by_q - at[k, 4] * by_p)
        by[k, 1] = -by_z * (at[k, 5] * by_p + at[k, 4] * by_q)
        by[k, 2], by[k, 3] = by_z * by_heading, by_z * by_range
        by[k, 4] = by_rate * (1.0 - rate * min(packed.peak[m], MOST_CERTAIN))
        by[k, 5], by[k, 6] = by_z * (c * by_p - s * by_q), by_z * (s * by_p + c * by_q)
    return nll, mean, variance


@compiled
def _add_measurement(
    packed: Packed,
    antenna: int,
    at: Array,
    offset: Array,
    twist: Array,
    columns: Integers,
    pull: Array,
    curve: Array,
    gradient: Array,
    information: Array,
) -> None:
    """Convert the derivatives of one measurement, and add them to ``gradient`` (D,) and ``information`` (D, D).

    ``pull`` (5,), ``curve`` (5, 5): gradient and lower triangle of the information by the antenna's position (2) and
    yaw, and by the parameters ``a`` and ``b`` of its model. ``at`` (8,): from :func:`place_measurements`. ``offset``
    (3,), ``twist`` (3,): the robot's pose in the reference frame, and its velocity. ``columns`` (Q,): the component of
    each parameter in the gradient, -1 if it is not estimated.
    """
    own, by, count = np.empty(MOST_COLUMNS, np.int64), np.zeros((MOST_COLUMNS, OF_READ)), 3
    own[0], own[1], own[2] = 0, 1, 2
    # a motion of the robot moves fixed antennas in the opposite direction in the robot frame
    sign = -1.0 if packed.fixed else 1.0
    by[0, 0] = by[1, 1] = by[2, 2] = sign
    by[2, 0], by[2, 1] = -sign * at[7], sign * at[6]
    model, turn = 2 * packed.which[antenna], 2 * len(packed.reach)
    for place, local in ((model, 3), (model + 1, 4), (turn, 2), (turn + 1 + antenna, 2)):
        if columns[place] >= 0:
            own[count], by[count, local] = columns[place], 1.0
            count += 1
    if columns[-1] >= 0:
        c, s = math.cos(offset[2]), math.sin(offset[2])
        own[count], by[count, 2] = columns[-1], sign * twist[2]
        by[count, 0] = sign * (c * twist[0] - s * twist[1] - twist[2] * (at[7] - offset[1]))
        by[count, 1] = sign * (s * twist[0] + c * twist[1] + twist[2] * (at[6] - offset[0]))
        count += 1
    for a in range(count):
        row = np.zeros(OF_READ)
        for i in range(OF_READ):
            gradient[own[a]] += by[a, i] * pull[i]
            for j in range(OF_READ):
                row[j] += by[a, i] * curve[max(i, j), min(i, j)]
        for b in range(a + 1):
            value = 0.0
            for j in range(OF_READ):
                value += row[j] * by[b, j]
            information[own[a], own[b]] += value
            if b < a:
                information[own[b], own[a]] += value


@compiled(error_model="numpy", fastmath=FAST)
def scores(
    packed: Packed, of_map: MapTags, counts: Counts, tempering: float, poses: Array, columns: Integers
) -> tuple[Array, Array, Array, Array, Array]:
    """Return ``nll`` (N,), ``gradient``, ``information``, ``expected`` (N,) and ``variance`` (N,) of read ``counts`` at
    poses (N, 3), see :class:`~factors.rfid.detection.Score`. ``packed``: models with parameters applied. ``of_map``:
    tags. ``tempering``: exponent. ``columns`` (Q,): gradient component of each parameter, -1 if not estimated."""
    antennas, rounds, twists = counts[1], counts[2], counts[8]
    offsets = delayed(counts[0], twists, packed.delay)
    count, scans, size = len(poses), len(antennas), 3
    for i in range(len(columns)):
        size += columns[i] >= 0
    local = OF_READ if size > 3 else 3
    near = near_tags(of_map, counts, poses, reach_of(packed, offsets))
    hits, tags = near.hits, len(near.tags)
    reads, far, none = np.zeros(tags, np.int64), _unread(packed, rounds), np.zeros(3)
    for k in range(scans):
        none += far[k]
        reads += hits[k]
    nll, expected, variance = np.empty(count), np.empty(count), np.empty(count)
    gradient, information = np.zeros((count, size)), np.zeros((count, size, size))
    at, by, slope, curve = np.empty((scans, ROW)), np.empty((scans, PLACE)), np.empty(scans), np.empty(scans)
    pulls, curves = np.empty((scans, OF_READ)), np.empty((scans, OF_READ, OF_READ))
    for n in range(count):
        farthest = place_measurements(packed, poses[n], offsets, antennas, at)
        # the tags that are not near any pose are out of reach and not read
        beyond = len(of_map.points) - tags
        e_sum = mean_sum = variance_sum = 0.0
        pulls[:], curves[:] = 0.0, 0.0
        for t in range(tags):
            dx, dy = near.points[t, 0] - poses[n, 0], near.points[t, 1] - poses[n, 1]
            if reads[t] == 0 and dx * dx + dy * dy >= farthest * farthest:
                beyond += 1
                continue
            point, normal = near.points[t], near.normals[t]
            e, mean, own = _add_tag(packed, at, antennas, rounds, hits[:, t], point, normal, far, by, slope, curve)
            share, e, mean, own = mixture(near.odds[t], near.elsewhere[t], e, mean, own, none[0], tempering)
            e_sum, mean_sum, variance_sum = e_sum + e, mean_sum + mean, variance_sum + own
            for k in range(scans):
                if curve[k] > 0.0:
                    for i in range(local):
                        pulls[k, i] += share * slope[k] * by[k, i]
                        for j in range(i + 1):
                            curves[k, i, j] += share * curve[k] * by[k, i] * by[k, j]
        nll[n] = e_sum + tempering * beyond * none[0]
        expected[n] = mean_sum + tempering * beyond * none[1]
        variance[n] = variance_sum + tempering * beyond * none[2]
        for k in range(scans):
            _add_measurement(
                packed,
                antennas[k],
                at[k],
                offsets[k],
                twists[k],
                columns,
                pulls[k],
                curves[k],
                gradient[n],
                information[n],
            )
    return nll, gradient, information, expected, variance


@compiled
def score(
    packed: Packed, of_map: MapTags, counts: Counts, alpha: float, pose: Array, parameters: Array, estimated: Integers
) -> tuple[float, Array, Array, float, float]:
    """Return five values of read ``counts`` at one pose (3,): tempered negative log-likelihood, its gradient (3 + P,),
    its Fisher information (3 + P, 3 + P), its mean, and its variance. Derivatives are by the pose and by parameters
    with indices ``estimated`` (P,). ``packed``: models without ``parameters`` (Q,). ``alpha``: tempering exponent."""
    columns = np.full(len(parameters), -1, np.int64)
    for i in range(len(estimated)):
        columns[estimated[i]] = 3 + i
    poses = pose.copy().reshape(1, 3)
    summed = scores(adjusted(packed, parameters), of_map, counts, alpha, poses, columns)
    return summed[0][0], summed[1][0], summed[2][0], summed[3][0], summed[4][0]


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
    """Return the untempered negative log-likelihood (T,) of each of T tags that are as in the map, at one pose (3,).
    Also returns its gradient (T, 5) and Fisher information (T, 5, 5) by the pose (3) and the tag's world position (2).
    ``packed``: the models. ``points`` (T, 3), ``normals`` (T, 2): the tags. ``offsets`` (K, 3), ``antennas``,
    ``rounds`` (K,), ``hits`` (K, T): the data of K measurements."""
    scans, tags, size = len(antennas), len(points), 5
    nll, gradient, information = np.empty(tags), np.zeros((tags, size)), np.zeros((tags, size, size))
    at, far, by = np.empty((scans, ROW)), _unread(packed, rounds), np.empty((scans, PLACE))
    slope, curve, own = np.empty(scans), np.empty(scans), np.empty(size)
    place_measurements(packed, pose, offsets, antennas, at)
    for t in range(tags):
        nll[t] = _add_tag(packed, at, antennas, rounds, hits[:, t], points[t], normals[t], far, by, slope, curve)[0]
        for k in range(scans):
            if curve[k] > 0.0:
                own[0], own[1], own[3], own[4] = by[k, 0], by[k, 1], by[k, 5], by[k, 6]
                own[2] = by[k, 2] - by[k, 0] * at[k, 7] + by[k, 1] * at[k, 6]
                for i in range(size):
                    gradient[t, i] += slope[k] * own[i]
                    for j in range(size):
                        information[t, i, j] += curve[k] * own[i] * own[j]
    return nll, gradient, information


@compiled(error_model="numpy", fastmath=FAST)
def probabilities(
    packed: Packed, antennas: Integers, poses: Array, points: Array, normals: Array
) -> tuple[Array, Array]:
    """Return two arrays (N, T): the probability, including false reads, that one round of antenna ``antennas[n]`` on a
    robot at ``poses[n]`` reads each tag, and the horizontal distance [m] from the antenna to the tag. ``packed``: the
    models. ``points`` (T, 3), ``normals`` (T, 2): positions and fronts of T tags."""
    none = np.zeros(3)
    p, distance = np.empty((len(poses), len(points))), np.empty((len(poses), len(points)))
    for n in range(len(poses)):
        x, y, c, s = placed(packed, antennas[n], poses[n], none)
        rate = packed.rate[packed.which[antennas[n]]]
        for t in range(len(points)):
            z = of_tag(packed, antennas[n], x, y, c, s, points[t], normals[t])[0]
            p[n, t] = detection(packed, z, rate)[0]
            distance[n, t] = math.hypot(points[t, 0] - x, points[t, 1] - y)
    return p, distance


@compiled
def predicted(
    packed: Packed, of_map: MapTags, counts: Counts, pose: Array, parameters: Array
) -> tuple[Integers, Integers, Array, Array]:
    """Return observed and predicted reads at one pose (3,) of the C tags that are near or listed in ``counts``. The
    first array has the indices (C,) of the tags in the map. Three arrays (K, C) have the number of reads, the read
    probability, and the horizontal distance [m] from the antenna. ``packed``: models without ``parameters`` (Q,)."""
    own, antennas = adjusted(packed, parameters), counts[1]
    offsets = delayed(counts[0], counts[8], own.delay)
    near = near_tags(of_map, counts, pose.copy().reshape(1, 3), reach_of(own, offsets))
    p, distance = probabilities(own, antennas, moved(pose, offsets), near.points, near.normals)
    return near.tags, near.hits, p, distance
