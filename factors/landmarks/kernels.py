"""The compiled linearisation of looks at landmarks: graphs ask for it at every update, and for all looks of a run at its end."""

import math

import numpy as np

from factors.compiled import compiled
from factors.landmarks.model import TIME_OFFSET, whitened_into
from factors.robust import geman_mcclure_weight
from factors.se2 import Array, Integers
from factors.se2_kernels import exp, wrapped

# mounting; range scale, its two sigmas, bearing bias and sigma; whether a range is a depth, and the angle of its axis; robust scale
Model = tuple[tuple[float, float, float], tuple[float, float, float, float, float], bool, float, float]
# what a look may have: of the motion since its pose the offset (3,) and its covariance (3, 3), and the velocity (3,)
Carried = tuple[bool, Array, bool, Array, float, bool, Array]


@compiled
def linearize(
    model: Model,
    pose: Array,
    changes: Array,
    points: Array,
    ranges: Array,
    bearings: Array,
    carried: Carried,
    spreads: Array,
    error: Array,
    by_pose: Array,
    by_sensor: Array,
) -> None:
    """What :meth:`factors.landmarks.factor.BearingRangeFactor.whitened` returns of one look, with ``changes`` (6,) of the
    constants and ``spreads`` (K, 2, 2) of the points, or (0, 2, 2): whitened ``error`` (K, 2), ``by_pose`` (K, 2, 3), ``by_sensor``
    (K, 2, 6)."""
    mounting, (scale, sigma, relative, bias, bearing_sigma), depth, axis, _ = model
    displaced, offset, widened, covariance, count, moves, twist = carried
    x, y, turned = offset[0], offset[1], offset[2]
    if moves and changes[TIME_OFFSET] != 0.0:
        later = changes[TIME_OFFSET]
        a, b, turn = exp(twist[0] * later, twist[1] * later, twist[2] * later)
        c, s = math.cos(turned), math.sin(turned)
        x, y, turned, displaced = x + c * a - s * b, y + s * a + c * b, wrapped(turned + turn), True
    at = pose
    if displaced:
        c, s = math.cos(pose[2]), math.sin(pose[2])
        at = np.array((pose[0] + c * x - s * y, pose[1] + s * x + c * y, wrapped(pose[2] + turned)))
    by_point = np.zeros((len(points), 2, 2))
    mounted = mounting[0] + changes[0], mounting[1] + changes[1], mounting[2]
    sensor = scale * (1.0 + changes[3]), sigma, relative, bias + changes[2], bearing_sigma
    whitened_into(
        at, mounted, sensor, depth, axis + changes[4], points, ranges, bearings, error, by_pose, by_point, by_sensor
    )
    c, s = math.cos(turned), math.sin(turned)
    lever_x, lever_y = s * x - c * y, c * x + s * y
    for k in range(len(points)):
        if moves:
            for i in range(2):
                by_sensor[k, i, TIME_OFFSET] = (
                    by_pose[k, i, 0] * twist[0] + by_pose[k, i, 1] * twist[1] + by_pose[k, i, 2] * twist[2]
                )
        if widened or len(spreads):
            uu, uv, vv = 1.0, 0.0, 1.0
            if len(spreads):
                a, b, d = _carried(by_point[k], spreads[k])
                uu, uv, vv = uu + a, uv + b, vv + d
            if widened:
                a, b, d = _carried(by_pose[k], covariance)
                uu, uv, vv = uu + count * a, uv + count * b, vv + count * d
            # of the inverse of the lower root
            p = 1.0 / math.sqrt(uu)
            low = uv * p
            q = 1.0 / math.sqrt(max(vv - low * low, 1e-12 * vv))
            r = -low * p * q
            error[k, 1] = r * error[k, 0] + q * error[k, 1]
            error[k, 0] *= p
            for j in range(3):
                by_pose[k, 1, j] = r * by_pose[k, 0, j] + q * by_pose[k, 1, j]
                by_pose[k, 0, j] *= p
            for j in range(TIME_OFFSET + 1):
                by_sensor[k, 1, j] = r * by_sensor[k, 0, j] + q * by_sensor[k, 1, j]
                by_sensor[k, 0, j] *= p
        if displaced:
            for i in range(2):
                u, v, w = by_pose[k, i, 0], by_pose[k, i, 1], by_pose[k, i, 2]
                by_pose[k, i, 0], by_pose[k, i, 1] = u * c - v * s, u * s + v * c
                by_pose[k, i, 2] = u * lever_x + v * lever_y + w


@compiled
def _carried(jacobian: Array, covariance: Array) -> tuple[float, float, float]:
    """The elements (0, 0), (1, 0) and (1, 1) of what a Jacobian (2, D) makes of a covariance (D, D)."""
    a = b = d = 0.0
    for i in range(len(covariance)):
        for j in range(len(covariance)):
            a += jacobian[0, i] * covariance[i, j] * jacobian[0, j]
            b += jacobian[1, i] * covariance[i, j] * jacobian[0, j]
            d += jacobian[1, i] * covariance[i, j] * jacobian[1, j]
    return a, b, d


@compiled
def weigh(error: Array, by_pose: Array, by_sensor: Array, robust: float) -> None:
    """Multiply what :func:`linearize` found by the roots of the robust weights."""
    for k in range(len(error)):
        root = math.sqrt(geman_mcclure_weight(error[k, 0] ** 2 + error[k, 1] ** 2, robust))
        for i in range(2):
            error[k, i] *= root
            for j in range(3):
                by_pose[k, i, j] *= root
            for j in range(TIME_OFFSET + 1):
                by_sensor[k, i, j] *= root


@compiled(error_model="numpy")
def beyond(
    model: Model,
    pose: Array,
    points: Array,
    ranges: Array,
    bearings: Array,
    carried: Carried,
    spreads: Array,
    covariance: Array,
    limit: float,
) -> int:
    """How many landmarks have a normalised innovation squared above ``limit``, seen from a pose with body-frame ``covariance``
    (3, 3)."""
    count = len(points)
    error, by_pose, by_sensor = np.zeros((count, 2)), np.zeros((count, 2, 3)), np.zeros((count, 2, TIME_OFFSET + 1))
    changes = np.zeros(TIME_OFFSET + 1)
    linearize(model, pose, changes, points, ranges, bearings, carried, spreads, error, by_pose, by_sensor)
    found = 0
    for k in range(count):
        a, b, c = 1.0, 0.0, 1.0
        for i in range(3):
            for j in range(3):
                a += by_pose[k, 0, i] * covariance[i, j] * by_pose[k, 0, j]
                b += by_pose[k, 0, i] * covariance[i, j] * by_pose[k, 1, j]
                c += by_pose[k, 1, i] * covariance[i, j] * by_pose[k, 1, j]
        x, y = error[k, 0], error[k, 1]
        # rounding may take all of the difference, which is never less than that
        determinant = max(a * c - b * b, 0.5 * (a + c))
        found += (c * x * x - 2.0 * b * x * y + a * y * y) / determinant > limit
    return found


@compiled
def linearize_all(
    model: Model,
    poses: Array,
    pose_of: Integers,
    changes: Array,
    ends: Integers,
    seen: tuple[Array, Array, Array],
    flags: Array,
    offsets: Array,
    covariances: Array,
    counts: Array,
    twists: Array,
    spreads: Array,
    error: Array,
    by_pose: Array,
    by_sensor: Array,
) -> None:
    """:func:`linearize` of L looks: that with the number l, at the pose ``pose_of`` (L,), is of the rows up to ``ends`` (L,).

    ``flags`` (L, 4): whether a look has an offset, a covariance of that, a velocity, and spreads of its points.
    """
    points, ranges, bearings = seen
    first = 0
    for i in range(len(ends)):
        rows = slice(first, ends[i])
        first = ends[i]
        carried = flags[i, 0], offsets[i], flags[i, 1], covariances[i], counts[i], flags[i, 2], twists[i]
        spread = spreads[rows] if flags[i, 3] else spreads[:0]
        linearize(
            model,
            poses[pose_of[i]],
            changes,
            points[rows],
            ranges[rows],
            bearings[rows],
            carried,
            spread,
            error[rows],
            by_pose[rows],
            by_sensor[rows],
        )
