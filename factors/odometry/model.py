"""The model of wheel odometry and gyro: relative poses with covariance.

Odometry is integrated in its own frame (:mod:`factors.odometry.chain`); a relative pose is the difference of two of its states.

Variances of longitudinal, lateral and heading errors grow linearly with distance, rotation and time, so that the result does not
depend on how a path is divided.

Rest is a measurement of zero velocity: errors that grow with time do not grow, and only the minimum noise acts. That minimum
applies to all odometry, because an increment without noise would make a graph singular.
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

# minimum noise of an increment without duration, whose covariance must be invertible
MINIMUM_POSITION_VARIANCE = 1e-8
MINIMUM_HEADING_VARIANCE = 1e-8
SLIPS = 0.01  # 1/s: how often wheels slip
LEAST_POSITION, LEAST_HEADING = 1e-3, 1e-4  # m, rad per sqrt(s): minimum noise


@dataclass(frozen=True, slots=True)
class Growth:
    """Standard deviation of one error component per square root of distance, rotation and time.

    The unit is that of the component (m or rad) per sqrt(m), per sqrt(rad) and per sqrt(s).
    """

    per_distance: float = 0.0
    per_rotation: float = 0.0
    per_time: float = 0.0

    def widened(self, *, per_distance: float = 0.0, per_rotation: float = 0.0, per_time: float = 0.0) -> "Growth":
        """With independent errors of these standard deviations added."""
        return Growth(
            math.hypot(self.per_distance, per_distance),
            math.hypot(self.per_rotation, per_rotation),
            math.hypot(self.per_time, per_time),
        )


@dataclass(frozen=True, slots=True)
class OdometryModel:
    """Wheel odometry, optionally with the rotation from a gyro.

    ``scale_distance``, ``scale_rotation``: true divided by reported motion. ``speed_bias`` [m/s], ``heading_rate_bias`` and
    ``gyro_bias`` [rad/s]: reported at rest; ``heading_drift`` [rad/m]: unreported change of heading. ``direction`` [rad]: of
    travel, in the robot frame. For commanded velocities: ``delay`` and ``lag`` [s], and ``turn_slowdown`` [m/rad], the loss of
    forward speed per turn rate. A velocity is held for at most ``max_hold`` seconds; then the motion is unknown, and its variance
    grows with ``unknown_distance`` [m per sqrt(s)] and ``unknown_rotation`` [rad per sqrt(s)].
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
        """The noise for compiled code: see :data:`factors.odometry.kernels.Noise`."""
        growths = (self.along, self.lateral, self.heading)
        sigmas = [s for g in growths for s in (g.per_distance, g.per_rotation, g.per_time)]
        sigmas += [self.unknown_distance, self.unknown_rotation]
        least = MINIMUM_POSITION_VARIANCE, MINIMUM_HEADING_VARIANCE, LEAST_POSITION**2, LEAST_HEADING**2
        return (float(self.direction), *(float(s) ** 2 for s in sigmas), *least)


def relative_motion(model: OdometryModel, start: ChainState, end: ChainState) -> Increment:
    """The motion between two states of a chain, with its covariance.

    The heading error is a random walk along the path, so it also displaces the end: by a third of its variance, and half of it as
    covariance, if the walk is uniform along the chord.
    """
    return Increment(*relative(np.array(model.noise()), start, end))


def slip(model: OdometryModel, increment: Increment, *, use_gyro: bool) -> tuple[Array, float]:
    """The covariance (3, 3) that an increment has more if its wheels slip, and minus the logarithm of how probable that is.

    The errors along the motion and of the heading are then those of an unknown motion, and displace the end as in
    :func:`relative_motion`. A gyro still measures the heading; wheels do not slip sideways.
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


# the constants that an increment can be corrected for: see `factors.odometry.kernels.recalibrate`
PARAMETERS = ("scale_distance", "scale_rotation", "heading_rate_bias", "heading_drift")


def composed(t: Array | NDArray[np.int64], moves: Array) -> tuple[NDArray[np.int64], Array]:
    """Compose motions with equal timestamps ``t`` (N,), sorted: indices (M,) of the last row of each timestamp, and the motions (M,
    3) since the timestamp before, from ``moves`` (N, 3)."""
    last = np.flatnonzero(np.append(np.diff(t) > 0, True)[: len(t)])
    first = np.append(0, last[:-1] + 1)[: len(last)]
    out = np.array(moves[first], dtype=float)
    for row in np.setdiff1d(np.arange(len(t)), first).tolist():
        place = int(np.searchsorted(last, row))
        out[place] = se2.compose(out[place], moves[row])
    return last, out
