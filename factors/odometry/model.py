"""The model of wheel odometry and gyro: relative poses with covariance.

Odometry is integrated in its own frame (:mod:`factors.odometry.chain`); a relative pose is the difference of two of its states.

Variances of longitudinal, lateral and heading errors grow linearly with distance, rotation and time, so that the result does not
depend on how a path is divided.

Rest is a measurement of zero velocity: errors that grow with time do not grow, and only the minimum noise acts. That minimum
applies to all odometry, because an increment without noise would make a graph singular.
"""

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.motion import ChainState, Increment
from factors.odometry import kernels
from factors.odometry.kernels import (
    NO_CONSTANTS,
    Noise,
    linearize,
    linearize_as_reported,
    linearize_changed,
    recalibrate,
    relative,
    whitener,
)
from factors.se2 import Array, Integers

# minimum noise of an increment without duration, whose covariance must be invertible
MINIMUM_POSITION_VARIANCE = 1e-8
MINIMUM_HEADING_VARIANCE = 1e-8
SLIPS, SHORTEST = 0.01, 1e-6  # 1/s: how often wheels slip; s: a duration that is not zero
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

    def variance(self, distance: float, rotation: float, duration: float) -> float:
        """The variance after ``distance`` metres, ``rotation`` radians (both unsigned) and ``duration`` seconds."""
        return self.per_distance**2 * distance + self.per_rotation**2 * rotation + self.per_time**2 * duration


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

    The error along the way, and that of the heading unless a gyro tells it, are then those of an unknown motion, with what they
    displace the end by as in :func:`relative_motion`; sideways wheels are held.
    """
    duration = max(increment.duration, SHORTEST)
    along, heading = model.unknown_distance**2 * duration, 0.0 if use_gyro else model.unknown_rotation**2 * duration
    x, y, turned = increment.delta.tolist()
    c, s, ahead = math.cos(turned), math.sin(turned), model.direction - turned / 2.0
    way, lever = np.array((math.cos(ahead), math.sin(ahead), 0.0)), np.array((s * x - c * y, c * x + s * y, 0.0))
    covariance = along * np.outer(way, way) + heading / 3.0 * np.outer(lever, lever)
    covariance[2] = covariance[:, 2] = heading / 2.0 * lever
    covariance[2, 2] = heading
    return covariance, -math.log(-math.expm1(-SLIPS * duration))


# the constants that recalibrated() changes
PARAMETERS = ("scale_distance", "scale_rotation", "heading_rate_bias", "heading_drift")


def recalibrated(increment: Increment, parameters: Array) -> tuple[Array, Array]:
    """The increment with corrected constants, and its Jacobian.

    ``parameters`` (..., 4): relative change of the distance scale, relative change of the rotation scale, additional heading-rate
    bias [rad/s] in motion, additional heading drift [rad/m]. Returns ``delta`` (..., 3) and the Jacobian (..., 3, 4) of its
    body-frame perturbation. The increment is treated as one arc, which is exact at constant curvature.
    """
    arc = se2.log(increment.delta)
    parameters = np.asarray(parameters, dtype=float)
    if parameters.ndim == 1:
        delta, jacobian = recalibrate(arc, increment.moving, parameters)
        return delta, jacobian
    x, y, phi = arc.tolist()
    by_parameter = np.array([[x, 0.0, 0.0, 0.0], [y, 0.0, 0.0, 0.0], [0.0, phi, -increment.moving, math.hypot(x, y)]])
    changed = arc + parameters @ by_parameter.T
    return se2.exp(changed), se2.right_jacobian(changed) @ by_parameter


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


class OdometryStack:
    """Increments ``factors``, each between the pose ``first`` (K,) by number and the next one. All have the same constants
    estimated, which are the parameters from ``column`` on."""

    def __init__(self, factors: Sequence["OdometryFactor"], first: Sequence[int], column: int) -> None:
        self._first, self._column = np.array(first, dtype=np.int64), column
        self._indices = np.array(factors[0].estimated, dtype=np.int64)
        packed = [f.packed for f in factors]
        self._deltas, self._twists = np.array([p[0] for p in packed]), np.array([p[1] for p in packed])
        self._moving, self._whiteners = np.array([p[2] for p in packed]), np.array([p[3] for p in packed])
        self.rows = 3 * len(packed)

    @property
    def first(self) -> Integers:
        """The number of the first pose that each residual depends on."""
        return np.repeat(self._first, 3)

    def linearize(self, poses: Array, parameters: Array, jacobian: Array, residual: Array) -> None:
        """Fill ``residual`` (3 K,) and ``jacobian`` (3 K, 6 + P), see :mod:`factors.chain`."""
        given = self._deltas, self._twists, self._moving, self._constants(parameters), self._indices, self._whiteners
        kernels.linearize_all(poses, self._first, *given, jacobian, residual, 6 + self._column)

    def cost(self, poses: Array, parameters: Array) -> float:
        """Half the sum of the squared residuals."""
        given = self._deltas, self._twists, self._moving, self._constants(parameters), self._indices, self._whiteners
        return float(kernels.cost_of_all(poses, self._first, *given))

    def _constants(self, parameters: Array) -> Array:
        return np.ascontiguousarray(parameters[self._column : self._column + len(self._indices)])


class OdometryFactor:
    """The increment between two poses, with odometry constants as a third variable.

    ``estimated``: indices in :data:`PARAMETERS` of the P constants. The values of the factor are the two poses (3,), and the
    constants (P,) unless P is zero.
    """

    def __init__(self, increment: Increment, estimated: Sequence[int] = ()) -> None:
        self._increment = increment
        self._arc = se2.log(increment.delta)
        self._moving = increment.duration - increment.still
        self.estimated = tuple(estimated)
        self._indices = np.array(estimated, dtype=np.int64)
        self._whitener = whitener(increment.covariance)

    @property
    def packed(self) -> tuple[Array, Array, float, Array]:
        """The increment (3,), its logarithm (3,), how long the robot moved, and what whitens it (3, 3)."""
        return self._increment.delta, self._arc, self._moving, self._whitener

    @property
    def kind(self) -> Hashable:
        """What increments have in common that are linearised together."""
        return self.estimated

    def stack(self, factors: Sequence["OdometryFactor"], numbers: Sequence[int], column: int) -> OdometryStack:
        """Increments of this kind as one: see :class:`~factors.graph.Stackable`."""
        return OdometryStack(factors, numbers, column)

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (3,) ``log(delta^-1 * start^-1 * end)`` and its Jacobians."""
        start, end, *constants = values
        if constants:
            changed = self._arc, self._moving, constants[0], self._indices
            residual, *blocks = linearize_changed(start, end, *changed, self._whitener)
            return residual, blocks
        residual, *blocks = linearize(start, end, self._increment.delta, NO_CONSTANTS, self._whitener)
        return residual, blocks[:2]

    def cost(self, values: Sequence[Array]) -> float:
        """Half the squared whitened residual."""
        residual, _ = self.linearize(values)
        return 0.5 * float(residual @ residual)


class ScaleFreeOdometryFactor(OdometryFactor):
    """An increment where the wheels alone tell the scale of what is estimated; its residual is in the unit that they report.

    A residual in metres becomes smaller as the world does, and nothing opposes that: the most probable world would be too small by
    ``n s^2``, where ``n`` increments are estimated and ``s`` is the standard deviation of the scale.
    """

    kind = None  # not linearised together

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (3,) ``log(delta^-1 * start^-1 * end)``, its translation divided by the scale, and its Jacobians."""
        start, end, *constants = values
        if not constants:
            return super().linearize(values)
        changed = self._arc, self._moving, constants[0], self._indices
        residual, *blocks = linearize_as_reported(start, end, *changed, self._whitener)
        return residual, blocks
