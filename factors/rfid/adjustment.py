"""Detection models whose range and read probability are not known exactly, and the likelihood as a function of these too.

Two parameters of each model take up what differs between installations (power, cables, kinds of tags). With ``a``, the logarithm of
a factor of the range, and ``b``, a shift of the logit of the largest read probability ``peak``, the model's ``p(x, y, z)`` of a tag
in the antenna's frame becomes

    rate * p(x / scale, y / scale, z),    scale = exp(a),    rate = sigmoid(logit(peak) + b) / peak,

which for a beam is another ``r_max`` (with its ``s_r`` in proportion) and another ``p0``. The parameters of M models are a vector
(2 M,): ``a`` and ``b`` of the first model, then of the second. With zeros the model is as it was.
"""

import math

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.rfid.kernels import FAST, counted, detection, of_tag, place_looks, terms
from factors.rfid.model import NEGLIGIBLE_LOGIT, Packed
from factors.se2 import Array

PARAMETERS = ("range_scale", "read_rate")  # of each model
MOST_CERTAIN = 0.99  # a larger peak is taken for this: it would leave the rate nothing to change


@compiled
def rate_of(peak: float, shift: float) -> float:
    """The factor of the probabilities of a model with largest probability ``peak``, whose logit shifts by ``shift``."""
    certain = min(peak, MOST_CERTAIN)
    return float(1.0 / (certain + (1.0 - certain) * math.exp(-shift)))


@compiled
def adjusted(packed: Packed, parameters: Array) -> Packed:
    """A model (as it was packed first) with these parameters (2 M,)."""
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


@compiled(error_model="numpy", fastmath=FAST)
def score(
    packed: Packed,
    pose: Array,
    points: Array,
    normals: Array,
    offsets: Array,
    antennas: NDArray[np.int64],
    rounds: NDArray[np.int64],
    hits: NDArray[np.int64],
    odds: Array,
    elsewhere: Array,
    tempering: float,
    gradient: Array,
    information: Array,
) -> tuple[float, float, float]:
    """Of one pose (3,) and an adjusted model: negative log-likelihood, its expectation and variance, as
    :class:`~factors.rfid.detection.Score`. ``gradient`` (3 + 2 M,) and ``information`` (3 + 2 M, 3 + 2 M), by the body-frame
    perturbation of the pose and the parameters, are filled."""
    looks, tags = hits.shape
    size = len(gradient)
    gradient[:], information[:] = 0.0, 0.0
    at = np.empty((looks, 8))
    farthest = place_looks(packed, pose, offsets, antennas, at)
    far = np.empty((looks, 3))
    none = mean_none = spread_none = 0.0
    for k in range(looks):
        far[k, 0], _, _, far[k, 1], far[k, 2] = terms(packed, NEGLIGIBLE_LOGIT, 1.0, 0, rounds[k])
        none, mean_none, spread_none = none + far[k, 0], mean_none + far[k, 1], spread_none + far[k, 2]
    nll = expected = variance = 0.0
    slope, curve = np.empty(size), np.empty((size, size))
    by, place = np.empty(5), np.array((0, 1, 2, 0, 0))
    for t in range(tags):
        dx, dy = points[t, 0] - pose[0], points[t, 1] - pose[1]
        heard = 0
        for k in range(looks):
            heard += hits[k, t]
        if heard == 0 and dx * dx + dy * dy >= farthest * farthest:
            nll, expected, variance = (
                nll + tempering * none,
                expected + tempering * mean_none,
                variance + tempering * spread_none,
            )
            continue
        slope[:], curve[:] = 0.0, 0.0
        here = mean = spread = 0.0
        for k in range(looks):
            x, y, c, s = at[k, 0], at[k, 1], at[k, 2], at[k, 3]
            z, by_p, by_q, by_heading, by_range = of_tag(packed, antennas[k], x, y, c, s, points[t], normals[t])
            if z == NEGLIGIBLE_LOGIT and hits[k, t] == 0:
                here, mean, spread = here + far[k, 0], mean + far[k, 1], spread + far[k, 2]
                continue
            m = packed.which[antennas[k]]
            rate = packed.rate[m]
            e, _, _, one_mean, one_spread = terms(packed, z, rate, hits[k, t], rounds[k])
            here, mean, spread = here + e, mean + one_mean, spread + one_spread
            q, by_z, by_rate = detection(packed, z, rate)
            by[0] = by_z * (at[k, 5] * by_q - at[k, 4] * by_p)
            by[1] = -by_z * (at[k, 5] * by_p + at[k, 4] * by_q)
            by[2] = by_z * by_heading - by[0] * at[k, 7] + by[1] * at[k, 6]
            by[3] = by_z * by_range
            by[4] = by_rate * (1.0 - rate * min(packed.peak[m], MOST_CERTAIN))
            place[3], place[4] = 3 + 2 * m, 4 + 2 * m
            g = -(hits[k, t] / q - (rounds[k] - hits[k, t]) / (1.0 - q))
            f = rounds[k] / (q * (1.0 - q))
            for i in range(5):
                slope[place[i]] += g * by[i]
                for j in range(5):
                    curve[place[i], place[j]] += f * by[i] * by[j]
        share, e, mean, spread = counted(odds[t], elsewhere[t], here, mean, spread, none, tempering)
        nll, expected, variance = nll + e, expected + mean, variance + spread
        for i in range(size):
            gradient[i] += share * slope[i]
            for j in range(size):
                information[i, j] += share * curve[i, j]
    return nll, expected, variance
