"""The compiled linearisation of looks at landmarks: graphs ask for it at every update, and for all looks of a run at its end."""

import math

import numpy as np

from factors.compiled import compiled
from factors.landmarks.model import BEARING_SIGMA, DEPTH, RANGE_SIGMA, RELATIVE, TIME_OFFSET, TURN, whitened_into
from factors.robust import geman_mcclure_weight
from factors.se2 import Array, Integers
from factors.se2_kernels import exp, wrapped

# points (K, 2), ranges (K,), bearings (K,); of the motion since the pose, each with whether there is one: the offset (3,), its
# covariance (3, 3) with the number of landmarks that have it in common, the velocity (3,); and spreads of the points (K, 2, 2), or
# (0, 2, 2)
Look = tuple[Array, Array, Array, bool, Array, bool, Array, float, bool, Array, Array]


@compiled
def linearize(
    model: Array, pose: Array, changes: Array, look: Look, error: Array, by_pose: Array, by_sensor: Array
) -> None:
    """What :meth:`factors.landmarks.factor.BearingRangeFactor.whitened` returns of one look, with ``changes`` (6,) of the
    constants: whitened ``error`` (K, 2), ``by_pose`` (K, 2, 3), ``by_sensor`` (K, 2, 6), which hold zeros. ``model``: of
    :func:`~factors.landmarks.model.packed`."""
    points, ranges, bearings, displaced, offset, widened, covariance, count, moves, twist, spreads = look
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
    mounted = model[0] + changes[0], model[1] + changes[1], model[TURN]
    noise = model[RANGE_SIGMA], model[RELATIVE], model[2] + changes[2], model[BEARING_SIGMA]
    whitened_into(
        at,
        mounted,
        (model[3] * (1.0 + changes[3]), *noise),
        model[DEPTH] > 0.0,
        model[4] + changes[4],
        points,
        ranges,
        bearings,
        error,
        by_pose,
        by_point,
        by_sensor,
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
            _widen(error[k], by_pose[k], by_sensor[k], uu, uv, vv)
        if displaced:
            _displace(by_pose[k], c, s, lever_x, lever_y)


@compiled
def _widen(error: Array, by_pose: Array, by_sensor: Array, uu: float, uv: float, vv: float) -> None:
    """Whiten the ``error`` (2,) of a landmark and its Jacobians (2, 3) and (2, 6) by a covariance [[uu, uv], [uv, vv]]."""
    # the inverse of its lower root [[p, 0], [r, q]]
    p = 1.0 / math.sqrt(uu)
    low = uv * p
    q = 1.0 / math.sqrt(max(vv - low * low, 1e-12 * vv))
    r = -low * p * q
    error[1] = r * error[0] + q * error[1]
    error[0] *= p
    for j in range(3):
        by_pose[1, j] = r * by_pose[0, j] + q * by_pose[1, j]
        by_pose[0, j] *= p
    for j in range(TIME_OFFSET + 1):
        by_sensor[1, j] = r * by_sensor[0, j] + q * by_sensor[1, j]
        by_sensor[0, j] *= p


@compiled
def _displace(by_pose: Array, c: float, s: float, lever_x: float, lever_y: float) -> None:
    """Turn a Jacobian (2, 3) by a pose into that by the pose before a motion: see :func:`~factors.displaced.displaced`."""
    for i in range(2):
        u, v, w = by_pose[i, 0], by_pose[i, 1], by_pose[i, 2]
        by_pose[i, 0], by_pose[i, 1] = u * c - v * s, u * s + v * c
        by_pose[i, 2] = u * lever_x + v * lever_y + w


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
def beyond(model: Array, pose: Array, look: Look, covariance: Array, limit: float) -> int:
    """How many landmarks have a normalised innovation squared above ``limit``, seen from a pose with body-frame ``covariance``
    (3, 3)."""
    count = len(look[0])
    error, by_pose, by_sensor = np.zeros((count, 2)), np.zeros((count, 2, 3)), np.zeros((count, 2, TIME_OFFSET + 1))
    linearize(model, pose, np.zeros(TIME_OFFSET + 1), look, error, by_pose, by_sensor)
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
    model: Array,
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
        spread = spreads[rows] if flags[i, 3] else spreads[:0]
        carried = flags[i, 0], offsets[i], flags[i, 1], covariances[i], counts[i], flags[i, 2], twists[i], spread
        look = (points[rows], ranges[rows], bearings[rows], *carried)
        linearize(model, poses[pose_of[i]], changes, look, error[rows], by_pose[rows], by_sensor[rows])
