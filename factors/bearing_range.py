"""Identified landmarks seen as bearing and range, or as range alone (ranging beacons).

A sensor sits on the robot at ``mounting`` (rTs). It reports ``range = range_scale * distance + noise`` and
``bearing = direction in the sensor's frame + bearing_bias + noise`` (Thrun, Burgard, Fox, "Probabilistic Robotics", 2005,
eq. 6.40). The noise is Gaussian in its core; far from it the loss of Geman and McClure levels off, jointly for range
and bearing of one landmark.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np

from factors import se2
from factors.se2 import Array

# the constants of a sensor that can be estimated: those of its model, and how much later it saw than its stamp says [s]
PARAMETERS = ("x", "y", "bearing_bias", "range_scale", "time_offset")


@dataclass(frozen=True, slots=True)
class BearingRangeModel:
    """What we believe about the sensor.

    ``mounting``: (x, y, heading) of the sensor in the robot's frame. ``range_scale``: reported over true. The standard
    deviation of a range r is ``hypot(range_sigma, range_sigma_relative * r)`` [m]; that of a bearing is ``bearing_sigma`` [rad].
    ``robust``: scale of the Geman-McClure loss in standard deviations.
    """

    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    range_scale: float = 1.0
    range_sigma: float = 0.1
    range_sigma_relative: float = 0.0
    bearing_bias: float = 0.0
    bearing_sigma: float = 0.05
    robust: float = 4.0


def predict(model: BearingRangeModel, poses: Array, points: Array) -> tuple[Array, Array]:
    """Expected range [m] and bearing [rad] of ``points`` (..., 2) in the world from ``poses`` (..., 3)."""
    sensors = se2.compose(poses, np.array(model.mounting))
    local = se2.transform_to(sensors, points)
    distance = np.hypot(local[..., 0], local[..., 1])
    bearing = np.arctan2(local[..., 1], local[..., 0])
    return model.range_scale * distance, se2.wrap(bearing + model.bearing_bias)


def jacobians(model: BearingRangeModel, poses: Array, points: Array) -> tuple[Array, Array, Array]:
    """Derivatives of (range, bearing) at ``poses`` (..., 3) and ``points`` (..., 2).

    Returns those by the pose's body-frame perturbation (..., 2, 3), by the point (..., 2, 2), and by the sensor's parameters
    (..., 2, 5): mounting x, y, heading, bearing bias, range scale.
    """
    poses = np.asarray(poses, dtype=float)
    mx, my, _ = model.mounting
    robot = se2.transform_to(poses, points)  # the point in the robot's frame
    dx, dy = robot[..., 0] - mx, robot[..., 1] - my
    distance = np.maximum(np.hypot(dx, dy), 1e-6)
    ux, uy = dx / distance, dy / distance
    # by the point in the robot's frame
    local = np.empty((*np.shape(distance), 2, 2))
    local[..., 0, 0], local[..., 0, 1] = model.range_scale * ux, model.range_scale * uy
    local[..., 1, 0], local[..., 1, 1] = -uy / distance, ux / distance
    by_pose = np.zeros((*local.shape[:-1], 3))
    by_pose[..., :2] = -local
    by_pose[..., 2] = local[..., 0] * robot[..., 1, None] - local[..., 1] * robot[..., 0, None]
    c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    to_robot = np.empty((*np.shape(c), 2, 2))
    to_robot[..., 0, 0], to_robot[..., 0, 1], to_robot[..., 1, 0], to_robot[..., 1, 1] = c, s, -s, c
    by_point = local @ to_robot
    by_sensor = np.zeros((*local.shape[:-1], 5))
    by_sensor[..., :2] = -local
    by_sensor[..., 1, 2] = -1.0
    by_sensor[..., 1, 3] = 1.0
    by_sensor[..., 0, 4] = distance
    return by_pose, by_point, by_sensor


def sigmas(model: BearingRangeModel, ranges: Array) -> Array:
    """Standard deviations (K, 2) of range and bearing at measured ``ranges`` (K,); a missing range has the near one's."""
    ranges = np.where(np.isnan(ranges), 0.0, ranges)
    out = np.empty((len(ranges), 2))
    out[:, 0] = np.hypot(model.range_sigma, model.range_sigma_relative * ranges)
    out[:, 1] = model.bearing_sigma
    return out


def residuals(model: BearingRangeModel, poses: Array, points: Array, ranges: Array, bearings: Array) -> Array:
    """Whitened residuals (..., K, 2), predicted less measured, of K points (K, 2) at ``poses`` (..., 1, 3) or (3,).

    A missing (NaN) range or bearing has residual zero.
    """
    expected_range, expected_bearing = predict(model, poses, points)
    sigma = sigmas(model, ranges)
    error = np.empty((*np.shape(expected_range), 2))
    error[..., 0] = (expected_range - ranges) / sigma[:, 0]
    error[..., 1] = se2.wrap(expected_bearing - bearings) / sigma[:, 1]
    error[np.isnan(error)] = 0.0
    return error


def whitened(
    model: BearingRangeModel, pose: Array, points: Array, ranges: Array, bearings: Array
) -> tuple[Array, Array]:
    """:func:`residuals` (K, 2) at one pose (3,), and their Jacobian (K, 2, 3) by its body-frame perturbation.

    Compiled, as it is the inner loop of every filter and graph; :func:`residuals` and :func:`jacobians` are its plain twins.
    """
    error, jacobian = np.zeros((len(points), 2)), np.zeros((len(points), 2, 3))
    _whitened(
        pose,
        model.mounting,
        (model.range_scale, model.range_sigma, model.range_sigma_relative, model.bearing_bias, model.bearing_sigma),
        points,
        ranges,
        bearings,
        error,
        jacobian,
    )
    return error, jacobian


@numba.njit(cache=True)
def _whitened(
    pose: Array,
    mounting: tuple[float, float, float],
    model: tuple[float, float, float, float, float],
    points: Array,
    ranges: Array,
    bearings: Array,
    error: Array,
    jacobian: Array,
) -> None:
    range_scale, range_sigma, range_sigma_relative, bearing_bias, bearing_sigma = model
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for k in range(len(points)):
        dx, dy = points[k, 0] - pose[0], points[k, 1] - pose[1]
        px, py = c * dx + s * dy, c * dy - s * dx  # in the robot's frame
        sx, sy = px - mounting[0], py - mounting[1]
        distance = max(math.hypot(sx, sy), 1e-6)
        ux, uy = sx / distance, sy / distance
        if not math.isnan(ranges[k]):
            weight = 1.0 / math.hypot(range_sigma, range_sigma_relative * ranges[k])
            error[k, 0] = (range_scale * distance - ranges[k]) * weight
            weight *= range_scale
            jacobian[k, 0, 0], jacobian[k, 0, 1] = -ux * weight, -uy * weight
            jacobian[k, 0, 2] = (ux * py - uy * px) * weight
        if not math.isnan(bearings[k]):
            turn = math.atan2(sy, sx) - mounting[2] + bearing_bias - bearings[k]
            error[k, 1] = (turn - 2.0 * math.pi * math.ceil((turn - math.pi) / (2.0 * math.pi))) / bearing_sigma
            weight = 1.0 / (distance * bearing_sigma)
            jacobian[k, 1, 0], jacobian[k, 1, 1] = uy * weight, -ux * weight
            jacobian[k, 1, 2] = (-uy * py - ux * px) * weight


def robust_weight(squared: Array, scale: float) -> Array:
    """Weight of a squared whitened residual under the loss of Geman and McClure (1985)."""
    return (1.0 + np.asarray(squared) / scale**2) ** -2


def robust_loss(squared: Array, scale: float) -> Array:
    """Loss of Geman and McClure of a squared whitened residual: a half of it where that is small, never above ``scale^2 / 2``.

    It forgets what is far off: a landmark that stands elsewhere than the map says does not pull at all.
    """
    return 0.5 * np.asarray(squared) / (1.0 + np.asarray(squared) / scale**2)


def log_likelihood(model: BearingRangeModel, poses: Array, points: Array, ranges: Array, bearings: Array) -> Array:
    """Log-likelihood (N,), up to a constant, of K measurements (K,) of points (K, 2) at ``poses`` (N, 3)."""
    error = residuals(model, poses[:, None, :], points, ranges, bearings)
    loss: Array = np.sum(robust_loss(np.sum(error**2, axis=-1), model.robust), axis=-1)
    return -loss


@dataclass(frozen=True, slots=True)
class BearingRangeFactor:
    """K landmarks of a known map seen at one time, as a factor on the robot's pose then or a little earlier.

    ``offset`` (3,): the pose at the measurement's time in the frame of the variable's pose, known from odometry;
    ``offset_covariance`` (3, 3): its body-frame covariance, which widens the noise. ``points`` (K, 2).
    """

    model: BearingRangeModel
    points: Array
    ranges: Array
    bearings: Array
    offset: Array | None = None
    offset_covariance: Array | None = None

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened, robustly weighted residual (2K,) and its Jacobian (2K, 3) by the pose ``values[0]`` (3,)."""
        error, jacobian = self.whitened(values[0])
        weight = np.sqrt(robust_weight(np.einsum("ki,ki->k", error, error), self.model.robust))
        return (weight[:, None] * error).ravel(), [(weight[:, None, None] * jacobian).reshape(-1, 3)]

    def cost(self, values: Sequence[Array]) -> float:
        """The robust loss at the pose ``values[0]``."""
        error, _ = self.whitened(values[0])
        return float(np.sum(robust_loss(np.sum(error**2, axis=-1), self.model.robust)))

    def widened(self, width: float) -> "BearingRangeFactor":
        """The same with a robust loss that is ``width`` times as wide."""
        return replace(self, model=replace(self.model, robust=width * self.model.robust))

    def whitened(self, pose: Array) -> tuple[Array, Array]:
        """Whitened residual (K, 2), predicted less measured, and its Jacobian (K, 2, 3), without the robust weight."""
        at = pose if self.offset is None else se2.compose(pose, self.offset)
        error, jacobian = whitened(self.model, at, self.points, self.ranges, self.bearings)
        if self.offset_covariance is not None:
            spread = jacobian @ self.offset_covariance @ np.swapaxes(jacobian, -1, -2) + np.eye(2)
            whitener = np.linalg.inv(np.linalg.cholesky(spread))
            error = np.einsum("kij,kj->ki", whitener, error)
            jacobian = whitener @ jacobian
        if self.offset is not None:
            jacobian = jacobian @ se2.adjoint(se2.inverse(self.offset))
        return error, jacobian
