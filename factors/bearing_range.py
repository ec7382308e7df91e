"""Identified landmarks seen as bearing and range, or as range alone (ranging beacons).

A sensor sits on the robot at ``mounting`` (rTs). It reports ``range = range_scale * distance + noise`` and
``bearing = direction in the sensor's frame + bearing_bias + noise`` (Thrun, Burgard, Fox, "Probabilistic
Robotics", 2005, eq. 6.40). The noise is Gaussian in its core with the heavy tails of a Cauchy loss, joint over range and bearing of one landmark.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from factors import se2
from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class BearingRangeModel:
    """What we believe about the sensor.

    ``mounting``: (x, y, heading) of the sensor in the robot's frame. ``range_scale``: reported over true. The standard
    deviation of a range r is ``hypot(range_sigma, range_sigma_relative * r)`` [m]; that of a bearing is ``bearing_sigma`` [rad].
    ``robust``: scale of the Cauchy loss in standard deviations.
    """

    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    range_scale: float = 1.0
    range_sigma: float = 0.1
    range_sigma_relative: float = 0.0
    bearing_bias: float = 0.0
    bearing_sigma: float = 0.05
    robust: float = 1.0


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


def cauchy_weight(squared: Array, scale: float) -> Array:
    """Weight of a squared whitened residual under the Cauchy loss (Holland and Welsch, 1977)."""
    return 1.0 / (1.0 + np.asarray(squared) / scale**2)


def cauchy_loss(squared: Array, scale: float) -> Array:
    """Cauchy loss of a squared whitened residual; a half of it where that is small."""
    return 0.5 * scale**2 * np.log1p(np.asarray(squared) / scale**2)


def log_likelihood(model: BearingRangeModel, poses: Array, points: Array, ranges: Array, bearings: Array) -> Array:
    """Log-likelihood (N,), up to a constant, of K measurements (K,) of points (K, 2) at ``poses`` (N, 3)."""
    error = residuals(model, poses[:, None, :], points, ranges, bearings)
    loss: Array = np.sum(cauchy_loss(np.sum(error**2, axis=-1), model.robust), axis=-1)
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
        weight = np.sqrt(cauchy_weight(np.sum(error**2, axis=-1), self.model.robust))
        return (weight[:, None] * error).ravel(), [(weight[:, None, None] * jacobian).reshape(-1, 3)]

    def cost(self, values: Sequence[Array]) -> float:
        """The robust loss at the pose ``values[0]``."""
        error, _ = self.whitened(values[0])
        return float(np.sum(cauchy_loss(np.sum(error**2, axis=-1), self.model.robust)))

    def widened(self, width: float) -> "BearingRangeFactor":
        """The same with a robust loss that is ``width`` times as wide."""
        return replace(self, model=replace(self.model, robust=width * self.model.robust))

    def whitened(self, pose: Array) -> tuple[Array, Array]:
        """Whitened residual (K, 2), predicted less measured, and its Jacobian (K, 2, 3), without the robust weight."""
        at = pose if self.offset is None else se2.compose(pose, self.offset)
        error = residuals(self.model, at, self.points, self.ranges, self.bearings)
        sigma = sigmas(self.model, self.ranges)
        jacobian = jacobians(self.model, at, self.points)[0] / sigma[:, :, None]
        jacobian[:, 0][np.isnan(self.ranges)] = 0.0
        jacobian[:, 1][np.isnan(self.bearings)] = 0.0
        if self.offset_covariance is not None:
            spread = jacobian @ self.offset_covariance @ np.swapaxes(jacobian, -1, -2) + np.eye(2)
            whitener = np.linalg.inv(np.linalg.cholesky(spread))
            error = np.einsum("kij,kj->ki", whitener, error)
            jacobian = whitener @ jacobian
        if self.offset is not None:
            jacobian = jacobian @ se2.adjoint(se2.inverse(self.offset))
        return error, jacobian
