"""The model of wheel odometry and gyro: relative poses with covariance.

:mod:`factors.odometry.chain` integrates the odometry in a frame of its own. A relative pose is the difference of two
states of this integration.

The variances of longitudinal, lateral and heading errors grow linearly with distance, rotation and time. The covariance
of a path therefore does not depend on its division into increments.

A robot at rest is a measurement of zero velocity. While the robot rests, its variances do not grow with time, except for a minimum
noise. The minimum noise is part of all increments, because an increment without noise would make a graph singular.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.motion import ChainState, Increment
from factors.odometry.kernels import (
    SHORTEST,
    Noise,
    relative,
)
from factors.se2 import Array

# Variances that are added to each increment, so that the covariance of an increment without duration is invertible: m^2, rad^2.
MINIMUM_POSITION_VARIANCE = 1e-8
MINIMUM_HEADING_VARIANCE = 1e-8
SLIPS = 0.01  # 1/s: the rate at which wheel slips begin
LEAST_POSITION, LEAST_HEADING = 1e-3, 1e-4  # m and rad per sqrt(s): minimum noise


@dataclass(frozen=True, slots=True)
class Growth:
    """The noise of one component of the odometry, a random walk. Its standard deviation grows with the square roots of
    distance, of rotation, and of time. ``per_distance``, ``per_rotation``, ``per_time``: the standard deviations per
    sqrt(m), per sqrt(rad) and per sqrt(s), in m for a translation and in rad for a rotation."""

    per_distance: float = 0.0
    per_rotation: float = 0.0
    per_time: float = 0.0

    def widened(self, *, per_distance: float = 0.0, per_rotation: float = 0.0, per_time: float = 0.0) -> "Growth":
        """Return the sum of this random walk and an independent one with these standard deviations."""
        return Growth(
            math.hypot(self.per_distance, per_distance),
            math.hypot(self.per_rotation, per_rotation),
            math.hypot(self.per_time, per_time),
        )


@dataclass(frozen=True, slots=True)
class OdometryModel:
    """The constants and the noise of wheel odometry, optionally with a gyro.

    ``scale_distance``, ``scale_rotation``: the true motion divided by the reported motion.
    ``speed_bias`` [m/s], ``heading_rate_bias`` [rad/s], ``gyro_bias`` [rad/s]: the values reported by a robot at rest.
    ``heading_drift`` [rad/m]: the change of heading per distance that the wheels do not report.
    ``direction`` [rad]: the direction of travel in the robot frame.
    ``delay``, ``lag`` [s]: the dead time of commanded velocities, and the time constant of the robot's first-order
    response. ``turn_slowdown`` [m/rad]: the loss of forward speed per turn rate, for commanded velocities.
    ``max_hold`` [s]: the longest time for which a velocity is assumed to continue. After that the motion is unknown.
    ``unknown_distance`` [m per sqrt(s)], ``unknown_rotation`` [rad per sqrt(s)]: the noise of an unknown motion.
    ``along``, ``lateral``, ``heading``: the noise along the direction of travel, across it, and of the heading.
    """

    scale_distance: float = 1.0
    scale_rotation: float = 1.0
    speed_bias: float = 0.0
    heading_rate_bias: float = 0.0
    heading_drift: float = 0.0
    direction: float = 0.0
    delay: float = 0.0
    lag: float = 0.0
    turn_slowdown: float = 0.0
    gyro_bias: float = 0.0
    max_hold: float = 1.5
    unknown_distance: float = 0.2
    unknown_rotation: float = 0.2
    along: Growth = field(default_factory=Growth)
    lateral: Growth = field(default_factory=Growth)
    heading: Growth = field(default_factory=Growth)

    def noise(self) -> Noise:
        """Return the noise of the model as a tuple for compiled code. See :data:`factors.odometry.kernels.Noise`."""
        growths = (self.along, self.lateral, self.heading)
        sigmas = [s for g in growths for s in (g.per_distance, g.per_rotation, g.per_time)]
        sigmas += [self.unknown_distance, self.unknown_rotation]
        least = MINIMUM_POSITION_VARIANCE, MINIMUM_HEADING_VARIANCE, LEAST_POSITION**2, LEAST_HEADING**2
        return (float(self.direction), *(float(s) ** 2 for s in sigmas), *least)


def relative_motion(model: OdometryModel, start: ChainState, end: ChainState) -> Increment:
    """Return the motion between two states of the integrated odometry, with its covariance.

    The heading error is a random walk along the path, so it also displaces the end of the motion. Let v be the variance
    of the heading, and r the distance from start to end. For a uniform walk along a straight line, the variance of the
    displacement is v r^2 / 3. Its covariance with the heading is v r / 2.
    """
    return Increment(*relative(np.array(model.noise()), start, end))


def slip(model: OdometryModel, increment: Increment, *, use_gyro: bool) -> tuple[Array, float]:
    """Return the additional covariance (3, 3) of an increment with slipping wheels, and the negative log-probability of
    a slip during the increment.

    The additional errors are those of an unknown motion along the direction of travel and, if ``use_gyro`` is False, of
    an unknown rotation. Wheels do not slip sideways.
    """
    duration = max(increment.duration, SHORTEST)
    along, heading = model.unknown_distance**2 * duration, 0.0 if use_gyro else model.unknown_rotation**2 * duration
    x, y, turned = increment.delta.tolist()
    c, s, ahead = math.cos(turned), math.sin(turned), model.direction - turned / 2.0
    direction, lever = np.array((math.cos(ahead), math.sin(ahead), 0.0)), np.array((s * x - c * y, c * x + s * y, 0.0))
    covariance = along * np.outer(direction, direction) + heading / 3.0 * np.outer(lever, lever)
    covariance[2] = covariance[:, 2] = heading / 2.0 * lever
    covariance[2, 2] = heading
    return covariance, -math.log(-math.expm1(-SLIPS * duration))


# The constants that can be estimated: `factors.odometry.kernels.recalibrate` corrects an increment for changes of these.
PARAMETERS = ("scale_distance", "scale_rotation", "heading_rate_bias", "heading_drift")


def composed(t: Array | NDArray[np.int64], moves: Array) -> tuple[NDArray[np.int64], Array]:
    """Compose the motions that have equal timestamps.

    ``t`` (N,): sorted timestamps. ``moves`` (N, 3): motions. Returns the index of the last row of each distinct
    timestamp (M,), and the composed motion (M, 3) of each distinct timestamp.
    """
    last = np.flatnonzero(np.append(np.diff(t) > 0, True)[: len(t)])
    first = np.append(0, last[:-1] + 1)[: len(last)]
    out = np.array(moves[first], dtype=float)
    for row in np.setdiff1d(np.arange(len(t)), first).tolist():
        place = int(np.searchsorted(last, row))
        out[place] = se2.compose(out[place], moves[row])
    return last, out
