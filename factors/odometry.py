"""Wheel odometry (and a gyro): from rows of a log to relative poses with covariance.

The path of the wheels is kept as a chain of *knots* in an odometry frame; any relative pose is the difference of two poses
of that chain. Between knots the robot follows a circular arc (Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, eq. 5.9).
Commanded velocities act after a delay and through a first-order lag, ``v' = (u(t - delay) - v) / lag``.

Noise: variances of along-track, lateral and heading error each grow linearly with distance, rotation and time, so that the
result does not depend on how finely a path is cut into pieces.
"""

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from factors import se2
from factors.se2 import Array

MINIMUM_POSITION_VARIANCE = 1e-8
MINIMUM_HEADING_VARIANCE = 1e-8


@dataclass(frozen=True, slots=True)
class Growth:
    """Standard deviation of one error component per square root of distance, rotation and time.

    The unit is that of the component (m or rad) per sqrt(m), per sqrt(rad) and per sqrt(s).
    """

    per_distance: float = 0.0
    per_rotation: float = 0.0
    per_time: float = 0.0

    def variance(self, distance: float, rotation: float, duration: float) -> float:
        """The variance after ``distance`` metres, ``rotation`` radians (both unsigned) and ``duration`` seconds."""
        return self.per_distance**2 * distance + self.per_rotation**2 * rotation + self.per_time**2 * duration


@dataclass(frozen=True, slots=True)
class OdometryModel:
    """What we believe about wheel odometry (and about the gyro that may replace its rotation).

    ``scale_distance``, ``scale_rotation``: true over reported motion. ``speed_bias`` [m/s], ``heading_rate_bias`` and
    ``gyro_bias`` [rad/s] are what is reported at rest. ``direction`` [rad]: that of travel, in the robot's frame.
    ``delay`` and ``lag`` [s] belong to commanded velocities. A velocity is held for at most ``max_hold`` seconds; after
    that the motion is unknown and its variance grows with ``unknown_distance`` [m per sqrt(s)] and ``unknown_rotation``.
    """

    scale_distance: float = 1.0
    scale_rotation: float = 1.0
    speed_bias: float = 0.0
    heading_rate_bias: float = 0.0
    direction: float = 0.0
    delay: float = 0.0
    lag: float = 0.0
    gyro_bias: float = 0.0
    max_hold: float = 1.5
    unknown_distance: float = 0.2
    unknown_rotation: float = 0.2
    along: Growth = field(default_factory=Growth)
    lateral: Growth = field(default_factory=Growth)
    heading: Growth = field(default_factory=Growth)


@dataclass(frozen=True, slots=True)
class Increment:
    """Relative motion between two times.

    ``delta`` (3,): pose of the end in the frame of the start. ``covariance`` (3, 3): of the body-frame perturbation at the
    end. ``duration`` [s].
    """

    delta: Array
    covariance: Array
    duration: float


@dataclass(frozen=True, slots=True)
class ChainState:
    """Where the odometry is at a time: pose in its own frame, path [m], turned angle [rad], time without odometry [s]."""

    t: float
    x: float
    y: float
    heading: float
    path: float
    turn: float
    unknown: float


@dataclass(frozen=True, slots=True)
class _Row:
    t: float  # when it takes effect
    kind: str  # velocity, increment or gyro
    values: tuple[float, ...]


class _Knot:
    """State at the time of a row, and the motion that follows until the next one."""

    __slots__ = ("heading", "path", "t", "turn", "unknown", "uw", "ux", "uy", "vx", "vy", "w", "x", "y")

    def __init__(self, t: float) -> None:
        self.t = t
        self.x = self.y = self.heading = 0.0
        self.path = self.turn = self.unknown = 0.0
        self.vx = self.vy = self.w = 0.0  # velocity in the robot's frame, now
        self.ux = self.uy = self.uw = 0.0  # the velocity that it tends to

    def state(self) -> ChainState:
        return ChainState(self.t, self.x, self.y, self.heading, self.path, self.turn, self.unknown)

    def after(self, duration: float, lag: float, hold: float) -> "_Knot":
        """The state ``duration`` seconds on: the motion goes on for at most ``hold`` of them, then it is unknown."""
        k = _Knot(self.t + duration)
        k.ux, k.uy, k.uw = self.ux, self.uy, self.uw
        moving = min(duration, hold)
        if lag > 0.0:
            decay = math.exp(-moving / lag)
            settling = lag * (1.0 - decay)
            dx = self.ux * moving + (self.vx - self.ux) * settling
            dy = self.uy * moving + (self.vy - self.uy) * settling
            dtheta = self.uw * moving + (self.w - self.uw) * settling
            k.vx = self.ux + (self.vx - self.ux) * decay
            k.vy = self.uy + (self.vy - self.uy) * decay
            k.w = self.uw + (self.w - self.uw) * decay
        else:
            k.vx, k.vy, k.w = self.ux, self.uy, self.uw
            dx, dy, dtheta = self.ux * moving, self.uy * moving, self.uw * moving
        if duration > hold:
            k.vx = k.vy = k.w = 0.0
        a, b = se2.arc_coefficients(dtheta)
        c, s = math.cos(self.heading), math.sin(self.heading)
        chord_x, chord_y = a * dx - b * dy, b * dx + a * dy
        k.x = self.x + c * chord_x - s * chord_y
        k.y = self.y + s * chord_x + c * chord_y
        k.heading = self.heading + dtheta
        k.path = self.path + math.hypot(dx, dy)
        k.turn = self.turn + abs(dtheta)
        k.unknown = self.unknown + duration - moving
        return k


class OdometryChain:
    """The odometry of a run so far, as a chain of knots in its own frame.

    Rows come in time order, or late (then the knots behind them are computed anew). Beyond the last row its velocity is held.
    What lies more than ``horizon`` seconds before the newest row is forgotten; adding a row older than that returns False.
    """

    def __init__(self, model: OdometryModel, *, use_gyro: bool = False, horizon: float = 5.0) -> None:
        self.model = model
        self._use_gyro = use_gyro
        self._horizon = horizon
        self._rows: list[_Row] = []
        self._knots: list[_Knot] = []
        self._times: list[float] = []
        self._forgotten = False

    def add_velocity(self, t: float, v: float, w: float) -> bool:
        """A row with forward velocity [m/s] and turn rate [rad/s], held from ``t`` until the next row."""
        return self._insert(_Row(t + self.model.delay, "velocity", (v, w)))

    def add_increment(self, t: float, dx: float, dy: float, dtheta: float) -> bool:
        """A row with the motion from the previous row until ``t``, in the robot's frame at the previous row."""
        return self._insert(_Row(t, "increment", (dx, dy, dtheta)))

    def add_yaw_rate(self, t: float, w: float) -> bool:
        """A gyro's row [rad/s], held from ``t`` until the next; it replaces the rotation that the wheels tell."""
        return self._insert(_Row(t, "gyro", (w,)))

    def state(self, t: float) -> ChainState:
        """The state of the chain at ``t``; before the first kept knot the robot is taken to stand, its motion unknown."""
        if not self._knots:
            return ChainState(t, 0.0, 0.0, 0.0, 0.0, 0.0, t)
        i = bisect.bisect_right(self._times, t) - 1
        if i >= 0:
            knot = self._knots[i]
            return knot.after(t - knot.t, self.model.lag, self.model.max_hold).state()
        first = self._knots[0]
        return ChainState(t, first.x, first.y, first.heading, first.path, first.turn, first.unknown - (first.t - t))

    def relative(self, start: ChainState, end: ChainState) -> Increment:
        """The motion from ``start`` to ``end``.

        ``start`` may be what was believed at its time: the difference then includes what later rows corrected.
        """
        return relative_motion(self.model, start, end)

    def _insert(self, row: _Row) -> bool:
        if self._forgotten and row.t < self._times[0]:
            return False
        i = bisect.bisect_right(self._times, row.t)
        if i < len(self._rows):
            self._rows.insert(i, row)
            self._rebuild(i)
        else:
            self._append(row)
            self._forget()
        return True

    def _rebuild(self, i: int) -> None:
        rows = self._rows[i:]
        del self._rows[i:], self._knots[i:], self._times[i:]
        for row in rows:
            self._append(row)

    def _append(self, row: _Row) -> None:
        previous = self._knots[-1] if self._knots else _Knot(row.t)
        duration = row.t - previous.t
        m = self.model
        if row.kind == "increment":
            knot = self._after_increment(previous, row)
        else:
            knot = previous.after(duration, m.lag, m.max_hold)
            if row.kind == "velocity":
                speed = m.scale_distance * (row.values[0] - m.speed_bias)
                knot.ux, knot.uy = speed * math.cos(m.direction), speed * math.sin(m.direction)
                if not self._use_gyro:
                    knot.uw = m.scale_rotation * (row.values[1] - m.heading_rate_bias)
            else:
                knot.uw = knot.w = row.values[0] - m.gyro_bias
        self._rows.append(row)
        self._knots.append(knot)
        self._times.append(knot.t)

    def _after_increment(self, previous: _Knot, row: _Row) -> _Knot:
        duration = row.t - previous.t
        if duration <= 0.0:
            return _Knot(row.t)  # the first row: when its motion began is not known
        m = self.model
        rho_x, rho_y, phi = (float(v) for v in se2.log(np.array(row.values)) / duration)
        rho_x -= m.speed_bias
        c, s = math.cos(m.direction), math.sin(m.direction)
        previous.ux = m.scale_distance * (c * rho_x - s * rho_y)
        previous.uy = m.scale_distance * (s * rho_x + c * rho_y)
        previous.uw = m.scale_rotation * (phi - m.heading_rate_bias)
        knot = previous.after(duration, 0.0, duration)
        knot.unknown += max(0.0, duration - m.max_hold)
        return knot

    def _forget(self) -> None:
        # seldom, and many at a time: removing from the front of a list costs its length
        if self._times[-1] - self._times[0] > 2.0 * self._horizon:
            keep = bisect.bisect_right(self._times, self._times[-1] - self._horizon) - 1
            del self._rows[:keep], self._knots[:keep], self._times[:keep]
            self._forgotten = True


def relative_motion(model: OdometryModel, start: ChainState, end: ChainState) -> Increment:
    """The motion between two states of a chain, with its covariance.

    The heading error is a random walk along the way, so it also displaces the end: with the chord seen from the end and
    the walk spread evenly over it, by a third of its variance (and half of it as covariance).
    """
    delta = se2.between(np.array((start.x, start.y, start.heading)), np.array((end.x, end.y, end.heading)))
    distance, rotation = abs(end.path - start.path), abs(end.turn - start.turn)
    duration = abs(end.t - start.t)
    unknown = max(0.0, end.unknown - start.unknown)
    along = model.along.variance(distance, rotation, duration) + model.unknown_distance**2 * unknown
    lateral = model.lateral.variance(distance, rotation, duration) + model.unknown_distance**2 * unknown
    heading = model.heading.variance(distance, rotation, duration) + model.unknown_rotation**2 * unknown
    # the start as seen from the end, turned by 90 degrees: how the end moves when the heading changes at the start
    c, s = math.cos(delta[2]), math.sin(delta[2])
    chord_x, chord_y = c * delta[0] + s * delta[1], -s * delta[0] + c * delta[1]
    nx, ny = -chord_y, chord_x
    # on the way the robot looked, on average, half the turn back from where it looks at the end
    travel = model.direction - delta[2] / 2.0
    d_along, d_lateral = math.cos(travel), math.sin(travel)
    covariance = np.array(
        [
            [
                d_along**2 * along + d_lateral**2 * lateral + heading * nx * nx / 3.0,
                d_along * d_lateral * (along - lateral) + heading * nx * ny / 3.0,
                heading * nx / 2.0,
            ],
            [0.0, d_lateral**2 * along + d_along**2 * lateral + heading * ny * ny / 3.0, heading * ny / 2.0],
            [0.0, 0.0, heading],
        ]
    )
    covariance[1, 0], covariance[2, 0], covariance[2, 1] = covariance[0, 1], covariance[0, 2], covariance[1, 2]
    # a robot at rest still needs a covariance that can be inverted
    covariance[0, 0] += MINIMUM_POSITION_VARIANCE
    covariance[1, 1] += MINIMUM_POSITION_VARIANCE
    covariance[2, 2] += MINIMUM_HEADING_VARIANCE
    return Increment(delta, covariance, duration)


# the constants that recalibrated() changes
PARAMETERS = ("scale_distance", "scale_rotation", "heading_rate_bias")


def recalibrated(increment: Increment, parameters: Array) -> tuple[Array, Array]:
    """The increment under changed parameters, and its Jacobian.

    ``parameters`` (..., 3): relative change of the distance scale, relative change of the rotation scale, additional
    heading-rate bias [rad/s]. Returns ``delta`` (..., 3) and the Jacobian (..., 3, 3) of its body-frame perturbation by the
    parameters. The increment is taken as one arc, exact at constant curvature.
    """
    x, y, phi = se2.log(increment.delta).tolist()
    by_parameter = np.array([[x, 0.0, 0.0], [y, 0.0, 0.0], [0.0, phi, -increment.duration]])
    changed = np.array((x, y, phi)) + np.asarray(parameters) @ by_parameter.T
    return se2.exp(changed), se2.right_jacobian(changed) @ by_parameter


def between_factor(from_key: int, to_key: int, increment: Increment) -> gtsam.NonlinearFactor:
    """The increment as GTSAM's factor between two ``Pose2`` variables."""
    noise = gtsam.noiseModel.Gaussian.Covariance(increment.covariance)
    return gtsam.BetweenFactorPose2(from_key, to_key, gtsam.Pose2(*increment.delta), noise)


class OdometryFactor:
    """The increment between two poses, with constants of the odometry as a third variable.

    ``estimated``: positions in :data:`PARAMETERS` of the P constants that the variable holds. The values of the factor are the two
    poses (3,) and the constants (P,), or the poses alone where P is zero.
    """

    def __init__(self, increment: Increment, estimated: Sequence[int] = ()) -> None:
        self._increment = increment
        self._estimated = list(estimated)
        self._whitener = np.linalg.inv(np.linalg.cholesky(increment.covariance))

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (3,) ``log(delta^-1 * start^-1 * end)`` and its Jacobians."""
        delta, by_parameter = self._delta(values)
        relative = se2.between(values[0], values[1])
        error = se2.log(se2.between(delta, relative))
        inverse = self._whitener @ np.linalg.inv(se2.right_jacobian(error))
        blocks = [-inverse @ se2.adjoint(se2.inverse(relative)), inverse]
        if self._estimated:
            blocks.append(-self._whitener @ np.linalg.inv(se2.right_jacobian(-error)) @ by_parameter)
        return self._whitener @ error, blocks

    def cost(self, values: Sequence[Array]) -> float:
        """Half the squared whitened residual."""
        error = self._whitener @ se2.log(se2.between(self._delta(values)[0], se2.between(values[0], values[1])))
        return 0.5 * float(error @ error)

    def _delta(self, values: Sequence[Array]) -> tuple[Array, Array]:
        if not self._estimated:
            return self._increment.delta, np.zeros((3, 0))
        parameters = np.zeros(len(PARAMETERS))
        parameters[self._estimated] = values[2]
        delta, jacobian = recalibrated(self._increment, parameters)
        return delta, jacobian[:, self._estimated]
