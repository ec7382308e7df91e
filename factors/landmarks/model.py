"""The measurement model of identified landmarks: bearing and range, or range only (ranging beacons).

The sensor's pose in the robot frame is ``mounting``. The sensor reports ``range = range_scale * distance + noise`` and ``bearing =
direction in the sensor frame + bearing_bias + noise`` (Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, eq. 6.40). The distance
is the slant distance if a landmark has a height above the sensor. A camera that measures range by apparent size reports the depth
instead: the distance times the cosine of the direction. The noise is Gaussian. The range and bearing of a landmark together have
one robust loss, that of Geman and McClure. A range without a bearing may be late (:mod:`factors.landmarks.late`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from factors import se2
from factors.compiled import compiled
from factors.landmarks.late import NONE, LateRanges, mixture
from factors.robust import geman_mcclure_loss
from factors.se2 import Array

# The constants of a sensor that can be estimated. The first five belong to the model; the last is the offset of the timestamps [s].
PARAMETERS = ("x", "y", "bearing_bias", "range_scale", "depth_axis", "time_offset")
TIME_OFFSET = PARAMETERS.index("time_offset")
# Columns of a full Jacobian: the pose (3), a point (2) from POINT on, and all PARAMETERS (6) from CONSTANTS on.
POINT, CONSTANTS, WIDTH = 3, 5, 11
EXACT = np.empty((0, 2, 2))  # covariances of exactly known points
# indices in ``BearingRangeModel.packed``, which begins with the first five PARAMETERS
TURN, RANGE_SIGMA, RELATIVE, BEARING_SIGMA, DEPTH, ROBUST, LATE = range(TIME_OFFSET, TIME_OFFSET + 7)
HEIGHT = 2  # column of the height above the sensor in points that have one
MINIMUM_COSINE = 0.1  # limit of the field of view of depth sensors


@dataclass(frozen=True, slots=True)
class BearingRangeModel:
    """A sensor of ranges and bearings to landmarks, its mounting on the robot, and its noise.

    ``mounting``: (x, y, heading) of the sensor in the robot frame [m, m, rad].
    ``range_scale``: the reported range divided by the true range.
    ``depth``: True if ranges are measured along one axis, as by a depth camera. ``depth_axis``: the direction of this
    axis in the sensor frame [rad]. ``range_sigma`` [m], ``range_sigma_relative``: the standard deviation of a range r
    is ``hypot(range_sigma, range_sigma_relative * r)``.
    ``bearing_bias``, ``bearing_sigma``: offset and standard deviation of bearings [rad].
    ``robust``: the scale of the Geman-McClure loss in standard deviations.
    ``late``: the statistics of ranges that are too long because of reflections. Ranges with a bearing are never late.
    ``packed``: the model as an array (14,) for compiled code.
    """

    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    range_scale: float = 1.0
    depth: bool = False
    depth_axis: float = 0.0
    range_sigma: float = 0.1
    range_sigma_relative: float = 0.0
    bearing_bias: float = 0.0
    bearing_sigma: float = 0.05
    robust: float = 4.0
    late: LateRanges = NONE
    packed: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        constants = *self.mounting[:2], self.bearing_bias, self.range_scale, self.depth_axis
        noise = self.range_sigma, self.range_sigma_relative, self.bearing_sigma
        packed = np.array((*constants, self.mounting[2], *noise, float(self.depth), self.robust, *self.late))
        object.__setattr__(self, "packed", packed)


def predict(model: BearingRangeModel, poses: Array, points: Array) -> tuple[Array, Array]:
    """Predict the ranges (...) [m] and bearings (...) [rad] of ``points`` from robot ``poses`` (..., 3).

    ``points``: world positions (..., 2), or (..., 3) with the height above the sensor as third coordinate.
    """
    sensors = se2.compose(poses, np.array(model.mounting))
    local = se2.transform_to(sensors, points[..., :2])
    distance = np.hypot(local[..., 0], local[..., 1])
    if points.shape[-1] > HEIGHT:
        distance = np.hypot(distance, points[..., HEIGHT])
    if model.depth:
        distance = math.cos(model.depth_axis) * local[..., 0] + math.sin(model.depth_axis) * local[..., 1]
    bearing = np.arctan2(local[..., 1], local[..., 0])
    return model.range_scale * distance, se2.wrap(bearing + model.bearing_bias)


def on_floor(model: BearingRangeModel, points: Array, ranges: Array) -> Array:
    """Convert slant ranges (K,) [m] to ranges (K,) [m] along the floor. ``points``: (K, 3) with the height above the
    sensor as third coordinate. If the points (K, 2) have no heights, the ranges are returned unchanged."""
    if points.shape[1] <= HEIGHT:
        return ranges
    squared = np.square(ranges / model.range_scale) - np.square(points[:, HEIGHT])
    return np.asarray(model.range_scale * np.sqrt(np.maximum(squared, 0.0)))


def located(model: BearingRangeModel, ranges: Array, bearings: Array) -> Array:
    """Return the positions (K, 2) of landmarks in the robot frame, from ranges (K,) [m] and bearings (K,) [rad]."""
    direction = bearings - model.bearing_bias
    distance = ranges / model.range_scale
    if model.depth:
        distance = distance / np.maximum(np.cos(direction - model.depth_axis), MINIMUM_COSINE)
    local = np.column_stack((distance * np.cos(direction), distance * np.sin(direction)))
    return se2.transform_from(np.array(model.mounting), local)


def sigmas(model: BearingRangeModel, ranges: Array) -> Array:
    """Return the standard deviations (K, 2) [m, rad] of range and bearing at ``ranges`` (K,) [m]. NaN counts as 0 m."""
    ranges = np.where(np.isnan(ranges), 0.0, ranges)
    out = np.empty((len(ranges), 2))
    out[:, 0] = np.hypot(model.range_sigma, model.range_sigma_relative * ranges)
    out[:, 1] = model.bearing_sigma
    return out


def residuals(model: BearingRangeModel, poses: Array, points: Array, ranges: Array, bearings: Array) -> Array:
    """Return the whitened residuals (..., K, 2) of range and bearing to K points (K, 2), predicted minus measured.
    ``poses``: (..., 1, 3) or (3,). ``ranges``, ``bearings`` (K,): if a measurement is NaN, its residual is zero."""
    expected_range, expected_bearing = predict(model, poses, points)
    sigma = sigmas(model, ranges)
    error = np.empty((*np.shape(expected_range), 2))
    error[..., 0] = (expected_range - ranges) / sigma[:, 0]
    error[..., 1] = se2.wrap(expected_bearing - bearings) / sigma[:, 1]
    error[np.isnan(error)] = 0.0
    return error


def recalibrated(model: BearingRangeModel, parameters: Sequence[float]) -> BearingRangeModel:
    """Return the model with corrected constants. ``parameters`` (6,): corrections of :data:`PARAMETERS`. They are
    added, except that the range scale is multiplied by one plus its correction. The time offset is ignored, because it
    is not part of the model."""
    by_x, by_y, by_bearing, by_scale, by_axis, _ = parameters
    x, y, turn = model.mounting
    return BearingRangeModel(
        (x + by_x, y + by_y, turn),
        model.range_scale * (1.0 + by_scale),
        model.depth,
        model.depth_axis + by_axis,
        model.range_sigma,
        model.range_sigma_relative,
        model.bearing_bias + by_bearing,
        model.bearing_sigma,
        model.robust,
    )


@lru_cache(maxsize=64)
def widened(model: BearingRangeModel, width: float) -> BearingRangeModel:
    """Return the model with the scale of its robust loss multiplied by ``width``."""
    return replace(model, robust=width * model.robust)


@lru_cache(maxsize=64)
def with_late(model: BearingRangeModel, late: LateRanges) -> BearingRangeModel:
    """Return the model with other statistics ``late`` of ranges that are too long because of reflections."""
    return replace(model, late=late)


def _constants(model: BearingRangeModel, parameters: Array) -> Array:
    """Return the constants (..., 5) of a model after corrections ``parameters`` (..., 6) of :data:`PARAMETERS`."""
    x, y, _ = model.mounting
    out: Array = (
        np.array((x, y, model.bearing_bias, model.range_scale, model.depth_axis)) + parameters[..., :TIME_OFFSET]
    )
    out[..., 3] = model.range_scale * (1.0 + parameters[..., 3])
    return out


@compiled
def whitened_into(
    pose: Array,
    mounting: tuple[float, float, float],
    model: tuple[float, float, float, float, float],
    depth: bool,
    depth_axis: float,
    points: Array,
    ranges: Array,
    bearings: Array,
    error: Array,
    jacobian: Array,
) -> None:
    """Write the whitened residuals of ranges and bearings at one pose, predicted minus measured, and their Jacobian.

    ``pose`` (3,): the robot's pose. ``mounting``: (x, y, heading) of the sensor in the robot frame. ``depth``: True if
    ranges are measured along the axis ``depth_axis`` [rad], as by a depth camera.
    ``model``: range scale, range sigma, relative range sigma, bearing bias, bearing sigma. ``points`` (K, 2) or (K, 3):
    landmarks. ``ranges``, ``bearings`` (K,): measured, NaN if missing.
    ``error`` (K, 2): output, the residuals. Must contain zeros before the call.
    ``jacobian`` (K, 2, WIDTH): output, the derivatives by the body-frame perturbation of the pose, by the point, and by
    :data:`PARAMETERS`. The change of the range scale is relative. The derivative by the time offset stays zero, because
    it needs the robot's velocity. Must contain zeros before the call.
    """
    range_scale, _, _, _, bearing_sigma = model
    c, s = math.cos(pose[2]), math.sin(pose[2])
    ahead_x, ahead_y = math.cos(mounting[2] + depth_axis), math.sin(mounting[2] + depth_axis)
    for k in range(len(points)):
        dx, dy = points[k, 0] - pose[0], points[k, 1] - pose[1]
        px, py = c * dx + s * dy, c * dy - s * dx  # in the robot frame
        sx, sy = px - mounting[0], py - mounting[1]
        height = points[k, HEIGHT] if points.shape[1] > HEIGHT else 0.0
        error[k, 0], error[k, 1], distance, vx, vy, reach, weight = _whitened(
            sx, sy, height, mounting[2], model, depth, ahead_x, ahead_y, ranges[k], bearings[k]
        )
        ux, uy = sx / distance, sy / distance
        if not math.isnan(ranges[k]):
            weight *= range_scale
            jacobian[k, 0, 0], jacobian[k, 0, 1] = -vx * weight, -vy * weight
            jacobian[k, 0, 2] = (vx * py - vy * px) * weight
            jacobian[k, 0, CONSTANTS + 3] = reach * weight
            jacobian[k, 0, CONSTANTS + 4] = (ahead_x * sy - ahead_y * sx) * weight if depth else 0.0
        if not math.isnan(bearings[k]):
            weight = 1.0 / (distance * bearing_sigma)
            jacobian[k, 1, 0], jacobian[k, 1, 1] = uy * weight, -ux * weight
            jacobian[k, 1, 2] = (-uy * py - ux * px) * weight
            jacobian[k, 1, CONSTANTS + 2] = 1.0 / bearing_sigma
        for i in range(2):
            # A shift of the sensor has the derivative of a shift of the robot. A shift of the point has the opposite derivative,
            # rotated to the world frame.
            a, b = jacobian[k, i, 0], jacobian[k, i, 1]
            jacobian[k, i, CONSTANTS], jacobian[k, i, CONSTANTS + 1] = a, b
            jacobian[k, i, POINT], jacobian[k, i, POINT + 1] = s * b - c * a, -s * a - c * b


@compiled(error_model="numpy")
def _whitened(
    sx: float,
    sy: float,
    height: float,
    turn: float,
    model: tuple[float, float, float, float, float],
    depth: bool,
    ahead_x: float,
    ahead_y: float,
    measured_range: float,
    measured_bearing: float,
) -> tuple[float, float, float, float, float, float, float]:
    """Return the whitened errors of range and bearing of one point, and intermediate values for derivatives.

    ``sx``, ``sy``, ``height``: the vector from the sensor to the point, along the robot's axes [m]. ``turn``: heading
    of the sensor in the robot frame. ``ahead_x``, ``ahead_y``: unit vector of the depth axis in the robot frame.
    ``model``, ``depth``: as in :func:`whitened_into`.

    The results are the errors of range and bearing, the point's distance along the floor, the derivatives of the
    unscaled range by ``sx`` and ``sy``, the unscaled range, and the range's inverse standard deviation.
    """
    range_scale, range_sigma, range_sigma_relative, bearing_bias, bearing_sigma = model
    range_error, bearing_error, weight = 0.0, 0.0, 0.0
    distance = max(math.sqrt(sx * sx + sy * sy), 1e-6)
    if depth:
        vx, vy, reach = ahead_x, ahead_y, ahead_x * sx + ahead_y * sy
    elif height == 0.0:
        vx, vy = sx / distance, sy / distance
        reach = vx * sx + vy * sy
    else:
        reach = math.sqrt(sx * sx + sy * sy + height * height)
        vx, vy = sx / reach, sy / reach
    if not math.isnan(measured_range):
        weight = 1.0 / math.sqrt(range_sigma**2 + (range_sigma_relative * measured_range) ** 2)
        range_error = (range_scale * reach - measured_range) * weight
    if not math.isnan(measured_bearing):
        angle = math.atan2(sy, sx) - turn + bearing_bias - measured_bearing
        bearing_error = (angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))) / bearing_sigma
    return range_error, bearing_error, distance, vx, vy, reach, weight


def log_likelihood(
    model: BearingRangeModel,
    poses: Array,
    points: Array,
    ranges: Array,
    bearings: Array,
    parameters: Array | None = None,
    point_covariances: Array | None = None,
) -> Array:
    """Return the log-likelihood (N,), up to a constant, of K landmark measurements at ``poses`` (N, 3).

    ``points``: world positions (K, 2), or (K, 3) with heights. ``ranges``, ``bearings`` (K,): NaN where missing.
    ``parameters`` (N, 6): corrections of :data:`PARAMETERS` for each pose, as in :func:`recalibrated`.
    ``point_covariances`` (K, 2, 2): covariances of the points, which are added to the noise. None if the map is exact.
    """
    changes = np.zeros((1, len(PARAMETERS))) if parameters is None else parameters
    constants = np.broadcast_to(_constants(model, changes), (len(poses), TIME_OFFSET))
    noise = (model.range_sigma, model.range_sigma_relative, model.bearing_sigma)
    losses = np.empty((len(poses), len(points)))
    sensor = (model.mounting[2], noise, model.depth, (model.robust, *model.late))
    covariances = EXACT if point_covariances is None else np.ascontiguousarray(point_covariances, dtype=float)
    _losses(poses, constants, *sensor, points, ranges, bearings, covariances, losses)
    return -np.asarray(np.sum(losses, axis=-1))


@compiled(error_model="numpy", fastmath={"arcp", "contract", "reassoc"})
def _losses(
    poses: Array,
    constants: Array,
    turn: float,
    noise: tuple[float, float, float],
    depth: bool,
    tails: tuple[float, float, float, float],
    points: Array,
    ranges: Array,
    bearings: Array,
    covariances: Array,
    losses: Array,
) -> None:
    """Write the negative log-likelihoods of K landmarks at N poses, each up to a constant, into ``losses`` (N, K).

    ``constants`` (N, 5): x, y, bearing bias, range scale and depth axis of the sensor for each pose. ``turn``: heading
    of the sensor in the robot frame. ``noise``: range sigma, relative range sigma, bearing sigma. ``depth``: as in
    :class:`BearingRangeModel`. ``tails``: scale of the robust loss, then share, mean and sigma of ranges that are too
    long. ``covariances`` (K, 2, 2): of the points, added to the noise, or (0, 2, 2) for exact points.
    """
    robust, share, mean, sigma = tails
    range_sigma, range_sigma_relative, bearing_sigma = noise
    axis = ahead_x = ahead_y = 0.0
    for i in range(len(poses)):
        c, s = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        x, y, bearing_bias, range_scale, depth_axis = constants[i]
        if depth and (i == 0 or depth_axis != axis):
            axis, ahead_x, ahead_y = depth_axis, math.cos(turn + depth_axis), math.sin(turn + depth_axis)
        model = (range_scale, range_sigma, range_sigma_relative, bearing_bias, bearing_sigma)
        for k in range(len(points)):
            dx, dy = points[k, 0] - poses[i, 0], points[k, 1] - poses[i, 1]
            sx, sy = c * dx + s * dy - x, c * dy - s * dx - y
            height = points[k, HEIGHT] if points.shape[1] > HEIGHT else 0.0
            range_error, bearing_error, distance, vx, vy, _, weight = _whitened(
                sx, sy, height, turn, model, depth, ahead_x, ahead_y, ranges[k], bearings[k]
            )
            squared, width, shrunk = range_error**2 + bearing_error**2, 0.0, 1.0
            if len(covariances):
                # (ax, ay), (bx, by): gradients of the whitened range and bearing by the point's world position. The range
                # grows along (vx, vy), the bearing perpendicular to the line of sight.
                by_range = range_scale * weight
                by_bearing = 0.0 if math.isnan(bearings[k]) else 1.0 / (distance * bearing_sigma)
                ax, ay = by_range * (c * vx - s * vy), by_range * (s * vx + c * vy)
                bx, by = by_bearing * (-s * sx - c * sy) / distance, by_bearing * (c * sx - s * sy) / distance
                xx, xy, yy = covariances[k, 0, 0], covariances[k, 0, 1], covariances[k, 1, 1]
                rr = 1.0 + ax * (xx * ax + xy * ay) + ay * (xy * ax + yy * ay)
                rb = ax * (xx * bx + xy * by) + ay * (xy * bx + yy * by)
                bb = 1.0 + bx * (xx * bx + xy * by) + by * (xy * bx + yy * by)
                # the exact determinant is at least half the trace, but rounding may cancel the difference completely
                determinant = max(rr * bb - rb * rb, 0.5 * (rr + bb))
                mixed = bb * range_error**2 - 2.0 * rb * range_error * bearing_error + rr * bearing_error**2
                squared, width, shrunk = mixed / determinant, 0.5 * math.log(determinant), 1.0 / math.sqrt(rr)
            if share > 0.0 and math.isnan(bearings[k]):
                tail = robust, share, mean, sigma
                losses[i, k] = width + mixture(shrunk * range_error, shrunk * weight, *tail)[0]
            else:
                losses[i, k] = width + geman_mcclure_loss(squared, robust)
