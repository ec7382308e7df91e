"""Compiled functions for landmark measurements: linearisation for graphs, and a Kalman update in information form for
filters. The update is equivalent to :func:`factors.update.update_state`. A filter computes a dozen small matrices per
measurement, and NumPy is slow for these."""

import math

import numpy as np

from factors.compiled import compiled
from factors.gaussian import cholesky, invert_covariance
from factors.landmarks.losses import resolve, reweigh, slopes, weigh
from factors.landmarks.model import (
    BEARING_SIGMA,
    CONSTANTS,
    DEPTH,
    PARAMETERS,
    POINT,
    RANGE_SIGMA,
    RELATIVE,
    TIME_OFFSET,
    TURN,
    WIDTH,
    whitened_into,
)
from factors.se2 import Array, Integers, compose_scalars, exp_scalars, moved
from factors.update import corrected, normalised

# One measurement of K landmarks. The elements are, in this order:
# - points (K, 2) or (K, 3), ranges (K,), bearings (K,);
# - True if there is an offset (the motion from the estimated pose to the measurement), and the offset (3,);
# - True if the offset has a covariance, the covariance (3, 3), and the number of landmarks that share the error;
# - True if the velocity is known, and the velocity (3,);
# - covariances of the points (K, 2, 2), or (0, 2, 2) if the points are exact.
Sighting = tuple[Array, Array, Array, bool, Array, bool, Array, float, bool, Array, Array]


@compiled
def linearize(model: Array, pose: Array, changes: Array, packed: Sighting, error: Array, jacobian: Array) -> None:
    """Linearise one measurement of K landmarks, as :meth:`factors.landmarks.factor.BearingRangeFactor.whitened` does.

    ``model`` (14,): the array ``packed`` of a :class:`~factors.landmarks.model.BearingRangeModel`. ``pose`` (3,): of
    the robot. ``changes`` (6,): corrections of the sensor constants. ``packed``: the measurement, see :data:`Sighting`.
    ``error`` (K, 2): output, the whitened residual. Must contain zeros before the call.
    ``jacobian`` (K, 2, WIDTH): output, its Jacobian by pose, landmark and constants. Must contain zeros, too.
    """
    points, ranges, bearings, displaced, offset, widened, covariance, count, moves, twist, surveys = packed
    x, y, turned = offset[0], offset[1], offset[2]
    if moves and changes[TIME_OFFSET] != 0.0:
        later = changes[TIME_OFFSET]
        a, b, turn = exp_scalars(twist[0] * later, twist[1] * later, twist[2] * later)
        x, y, turned = compose_scalars(x, y, turned, a, b, turn)
        displaced = True
    at = np.array(compose_scalars(pose[0], pose[1], pose[2], x, y, turned)) if displaced else pose
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
        jacobian,
    )
    c, s = math.cos(turned), math.sin(turned)
    lever_x, lever_y = s * x - c * y, c * x + s * y
    for k in range(len(points)):
        if moves:
            for i in range(2):
                row = jacobian[k, i]
                row[CONSTANTS + TIME_OFFSET] = row[0] * twist[0] + row[1] * twist[1] + row[2] * twist[2]
        if widened or len(surveys):
            uu, uv, vv = 1.0, 0.0, 1.0
            if len(surveys):
                a, b, d = _carried(jacobian[k, :, POINT:CONSTANTS], surveys[k])
                uu, uv, vv = uu + a, uv + b, vv + d
            if widened:
                a, b, d = _carried(jacobian[k], covariance)
                uu, uv, vv = uu + count * a, uv + count * b, vv + count * d
            _widen(error[k], jacobian[k], uu, uv, vv)
        if displaced:
            for i in range(2):  # convert the derivative by the pose at the measurement to that by the estimated pose
                u, v = jacobian[k, i, 0], jacobian[k, i, 1]
                jacobian[k, i, 0], jacobian[k, i, 1] = u * c - v * s, u * s + v * c
                jacobian[k, i, 2] += u * lever_x + v * lever_y


@compiled
def linearize_each(model: Array, poses: Array, points: Array, ranges: Array, bearings: Array) -> tuple[Array, Array]:
    """Return the whitened residuals (N, 2) of N landmark measurements, and their Jacobian (N, 2, WIDTH).
    ``poses`` (N, 3), ``points`` (N, 2) or (N, 3), ``ranges`` (N,), ``bearings`` (N,): the pose, the landmark and the
    values of each measurement. ``model`` (14,): constants of the sensor, as in :func:`linearize`."""
    error, jacobian = np.zeros((len(poses), 2)), np.zeros((len(poses), 2, WIDTH))
    mounted, depth = (model[0], model[1], model[TURN]), model[DEPTH] > 0.0
    noise = model[3], model[RANGE_SIGMA], model[RELATIVE], model[2], model[BEARING_SIGMA]
    for n in range(len(poses)):
        row = slice(n, n + 1)
        measured = points[row], ranges[row], bearings[row]
        whitened_into(poses[n], mounted, noise, depth, model[4], *measured, error[row], jacobian[row])
    return error, jacobian


@compiled
def _widen(error: Array, jacobian: Array, uu: float, uv: float, vv: float) -> None:
    """Whiten ``error`` (2,) and ``jacobian`` (2, WIDTH) of a landmark in place, by its covariance uu, uv, vv."""
    # [[p, 0], [r, q]] is the inverse of the lower Cholesky root of the covariance
    p = 1.0 / math.sqrt(uu)
    low = uv * p
    q = 1.0 / math.sqrt(max(vv - low * low, 1e-12 * vv))
    r = -low * p * q
    error[1] = r * error[0] + q * error[1]
    error[0] *= p
    for j in range(WIDTH):
        jacobian[1, j] = r * jacobian[0, j] + q * jacobian[1, j]
        jacobian[0, j] *= p


@compiled
def _carried(jacobian: Array, covariance: Array) -> tuple[float, float, float]:
    """Return the elements (0, 0), (1, 0) and (1, 1) of ``J covariance J^T``, a propagated ``covariance`` (D, D). J has
    the first D columns of ``jacobian``."""
    a = b = d = 0.0
    for i in range(len(covariance)):
        for j in range(len(covariance)):
            a += jacobian[0, i] * covariance[i, j] * jacobian[0, j]
            b += jacobian[1, i] * covariance[i, j] * jacobian[0, j]
            d += jacobian[1, i] * covariance[i, j] * jacobian[1, j]
    return a, b, d


@compiled(error_model="numpy")
def beyond(model: Array, pose: Array, packed: Sighting, covariance: Array, limit: float) -> int:
    """Return the number of landmarks with a normalised innovation squared above ``limit``. ``model`` (14,), ``packed``:
    the sensor and the measurement, as in :func:`linearize`. ``pose`` (3,), ``covariance`` (3, 3): the predicted pose
    and its body-frame covariance."""
    count = len(packed[0])
    error, by_pose, outliers = np.zeros((count, 2)), np.zeros((count, 2, WIDTH)), 0
    linearize(model, pose, np.zeros(TIME_OFFSET + 1), packed, error, by_pose)
    for k in range(count):
        a, b, c = _carried(by_pose[k], covariance)
        a, c, x, y = 1.0 + a, 1.0 + c, error[k, 0], error[k, 1]
        # the exact determinant is at least half the trace, but rounding may cancel the difference completely
        determinant = max(a * c - b * b, 0.5 * (a + c))
        outliers += (c * x * x - 2.0 * b * x * y + a * y * y) / determinant > limit
    return outliers


@compiled
def linearize_all(
    model: Array,
    poses: Array,
    pose_of: Integers,
    changes: Array,
    ends: Integers,
    measured: tuple[Array, Array, Array],
    flags: Array,
    offsets: Array,
    covariances: Array,
    counts: Array,
    twists: Array,
    surveys: Array,
    error: Array,
    jacobian: Array,
) -> None:
    """Linearise L measurements with :func:`linearize`. Together they have K landmarks, one per row of the arrays.

    ``model`` (14,): the sensor. ``poses`` (N, 3), ``pose_of`` (L,): poses, and the index of the pose of each
    measurement. ``ends`` (L,): the index after the last row of each. ``changes`` (6,): corrections of sensor constants.
    ``measured``: points, ranges and bearings, with K rows each.
    ``flags`` (L, 4): True where a measurement has an offset, an offset covariance, a velocity, and point covariances.
    ``offsets`` (L, 3), ``covariances`` (L, 3, 3), ``twists`` (L, 3): the offset, its covariance and the velocity of
    each measurement, ignored where the flag is False. ``counts`` (L,): the number of landmarks that have the error of
    an offset in common. ``surveys`` (K, 2, 2): point covariances.
    ``error`` (K, 2), ``jacobian`` (K, 2, WIDTH): outputs, which must contain zeros before the call.
    """
    points, ranges, bearings = measured
    first = 0
    for i in range(len(ends)):
        rows = slice(first, ends[i])
        first = ends[i]
        own = surveys[rows] if flags[i, 3] else surveys[:0]
        carried = flags[i, 0], offsets[i], flags[i, 1], covariances[i], counts[i], flags[i, 2], twists[i], own
        packed = (points[rows], ranges[rows], bearings[rows], *carried)
        linearize(model, poses[pose_of[i]], changes, packed, error[rows], jacobian[rows])


@compiled(error_model="numpy")
def updated(
    model: Array,
    packed: Sighting,
    pose: Array,
    covariance: Array,
    values: Array,
    indices: Integers,
    first: int,
    iterations: int,
    converged: float,
    gate: float,
) -> tuple[Array, Array, Array, float, int]:
    """Run a robust, iterated Kalman update by one measurement of K landmarks. See :func:`factors.update.update_state`.
    ``model`` (14,): the array ``packed`` of a :class:`~factors.landmarks.model.BearingRangeModel`. ``packed``: the
    measurement, see :data:`Sighting`. ``pose`` (3,), ``covariance`` (S, S): the prediction. The first three components
    of the error state are the pose. ``values`` (P,), ``indices`` (P,): corrections of the estimated sensor constants,
    and their indices in :data:`~factors.landmarks.model.PARAMETERS`. ``first``: the index of the first of these in the
    error state. ``iterations``: their maximum number. They end earlier when a step is below ``converged``.
    ``gate``: the noise of a landmark is increased if its normalised innovation squared exceeds this limit.
    Returns the correction (S,), the new covariance (S, S), the whitened residuals (K, 2) of the prediction, the
    normalised innovation squared, and the number of measured values. Raises LinAlgError if a covariance is singular."""
    count, size = len(packed[0]), len(covariance)
    columns = np.empty(3 + len(values), np.int64)
    for j in range(len(columns)):
        columns[j] = j if j < 3 else first + j - 3
    residual, jacobian, slope = np.empty((count, 2)), np.empty((count, 2, len(columns))), np.empty(count)
    _linearized(model, packed, pose, values, indices, residual, jacobian, slope)
    measured = 0
    for k in range(count):
        measured += (not math.isnan(packed[1][k])) + (not math.isnan(packed[2][k]))
    previous, weights = np.zeros(size), np.ones(count)
    prior = invert_covariance(covariance)
    delta, posterior, pull = corrected(prior, residual, jacobian, columns, weights, previous)
    nis, widest, squared = 0.0, 1.0, normalised(residual, jacobian, columns, covariance)
    for k in range(count):
        nis += residual[k, 0] ** 2 + residual[k, 1] ** 2
        widening = max(1.0, squared[k] / gate)
        widest = max(widest, widening)
        weights[k] = 1.0 / (widening * widening)
    for i in range(len(columns)):
        for j in range(len(columns)):
            nis -= pull[i] * posterior[columns[i], columns[j]] * pull[j]
    now, expected = residual.copy(), squared.copy()
    mixed = resolve(model, now, jacobian, columns, covariance, slope, gate, weights, expected)
    nis += (expected - squared).sum()  # a late range does not contradict the prediction
    if widest > 1.0 or mixed:
        delta, posterior, _ = corrected(prior, now, jacobian, columns, weights, previous)
    for _ in range(iterations - 1):
        if np.abs(delta - previous).max() < converged:
            break
        previous = delta
        _linearized(model, packed, moved(pose, delta), values + delta[columns[3:]], indices, now, jacobian, slope)
        reweigh(model, now, slope, weights)
        delta, posterior, _ = corrected(prior, now, jacobian, columns, weights, previous)
    if not (np.all(np.isfinite(delta)) and cholesky(posterior)[1]):
        raise np.linalg.LinAlgError(
            "an update has a step that is not finite, or a covariance that is not positive definite"
        )
    return delta, posterior, residual, max(0.0, nis), measured


@compiled(error_model="numpy")
def weighted(
    model: Array, packed: Sighting, pose: Array, values: Array, indices: Integers
) -> tuple[Array, Array, Array]:
    """Return the whitened residual (2K,) of K landmarks with robust weights, and its Jacobians by the pose (2K, 3) and
    the estimated constants (2K, P). ``model`` (14,), ``packed``: the sensor and the measurement. ``pose`` (3,): the
    robot's pose. ``values``, ``indices`` (P,): corrections of the estimated constants, and their indices."""
    count, wide = len(packed[0]), len(indices)
    residual, jacobian, slope = np.empty((count, 2)), np.empty((count, 2, 3 + wide)), np.empty(count)
    _linearized(model, packed, pose, values, indices, residual, jacobian, slope)
    weigh(model, residual, jacobian, slope)
    by_all = jacobian.reshape(2 * count, 3 + wide)
    return residual.reshape(2 * count), by_all[:, :3].copy(), by_all[:, 3:].copy()


@compiled(error_model="numpy")
def predicted(model: Array, packed: Sighting, pose: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """Return three arrays (K,) about the ranges in ``packed``, to detect ranges that are too long. These are the
    whitened errors, their derivatives by the range (:func:`slopes`), and the variances of the predicted ranges divided
    by the variance of the noise. ``model`` (14,): the sensor. ``pose`` (3,), ``covariance`` (3, 3): the prediction."""
    count = len(packed[0])
    error, jacobian, slope, variances = (
        np.zeros((count, 2)),
        np.zeros((count, 2, WIDTH)),
        np.empty(count),
        np.empty(count),
    )
    linearize(model, pose, np.zeros(TIME_OFFSET + 1), packed, error, jacobian)
    slopes(error, jacobian, packed[1], packed[2], slope)
    for k in range(count):
        variances[k] = _carried(jacobian[k], covariance)[0]
    return error[:, 0].copy(), slope, variances


@compiled(error_model="numpy")
def innovations(model: Array, residual: Array, ranges: Array, bearings: Array) -> tuple[Array, Array]:
    """Return the innovations of ranges [m] and bearings [rad], measured minus predicted, as two arrays.

    ``model`` (14,): the sensor, as in :func:`linearize`. ``residual`` (K, 2): the whitened residuals, predicted minus
    measured. ``ranges``, ``bearings`` (K,): measured, NaN if missing. Missing values are left out of the results.
    """
    by_range, by_bearing = np.empty(len(ranges)), np.empty(len(ranges))
    r = b = 0
    for k in range(len(ranges)):
        if not math.isnan(ranges[k]):
            by_range[r] = -residual[k, 0] * math.hypot(model[RANGE_SIGMA], model[RELATIVE] * ranges[k])
            r += 1
        if not math.isnan(bearings[k]):
            by_bearing[b] = -residual[k, 1] * model[BEARING_SIGMA]
            b += 1
    return by_range[:r], by_bearing[:b]


@compiled(error_model="numpy")
def _linearized(
    model: Array,
    packed: Sighting,
    pose: Array,
    values: Array,
    indices: Integers,
    residual: Array,
    jacobian: Array,
    slope: Array,
) -> None:
    """Write the whitened ``residual`` (K, 2), its ``jacobian`` (K, 2, 3 + P) by the pose and the estimated constants,
    and the derivatives ``slope`` (K,) of :func:`slopes`. The remaining arguments are those of :func:`updated`."""
    count = len(residual)
    changes = np.zeros(len(PARAMETERS))
    for j in range(len(values)):
        changes[indices[j]] = values[j]
    by_all = np.zeros((count, 2, WIDTH))
    linearize(model, pose, changes, packed, residual, by_all)
    slopes(residual, by_all, packed[1], packed[2], slope)
    for k in range(count):
        for i in range(2):
            for j in range(3):
                jacobian[k, i, j] = by_all[k, i, j]
            for j in range(len(values)):
                jacobian[k, i, 3 + j] = by_all[k, i, CONSTANTS + indices[j]]
