"""Motion of a robot in space between two times, for a filter with an error state of 12 values.

The error state is (rotation, translation, velocity, turn rate): rotation and translation (3,) of the pose in the robot's frame,
as of ``gtsam.Pose3``, the velocity (3,) in the world frame and the turn rate (3,) in the robot's.

Constant velocity: Davison, Reid, Molton, Stasse, "MonoSLAM: real-time single camera SLAM", IEEE Transactions on Pattern Analysis
and Machine Intelligence 29(6), 2007, section III.D: unknown accelerations a and alpha act as impulses a dt and alpha dt, so the
noise depends on the length of the steps.
"""

from __future__ import annotations

import bisect
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import gtsam
import numpy as np

from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.sensors.twist.measurement import in_space
from factorgraph_loc.sensors.twist.settings import TwistSettings
from factors.se2 import Array

ROBOT = 12  # values of the error state
TURN, SHIFT, VELOCITY, RATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
POSES, VELOCITIES = slice(0, 6), slice(6, 12)
PLANAR = [3, 4, 2]  # indices in the pose's error: x, y and heading of a level robot
UPRIGHT = [0, 1, 5]  # the components held by the floor: roll, pitch, height
NO_VELOCITY = [8, 9, 10]  # their velocities
SETTLING, UNEVEN = 1.0, 3.0  # s, time constant of the return to the floor; where its unevenness is learnt
HOLD = 1.0  # s, for which a measured velocity is held
SHORTEST = 1e-3  # s, shortest interval from which a velocity is computed
UNKNOWN = 0.5  # m and rad per sqrt(s) without measured motion


@dataclass(frozen=True)
class RobotState:
    """The 13 values: ``position`` (3,) [m] in the world, ``rotation`` (3, 3) of the robot in the world, in place of the
    quaternion, ``velocity`` (3,) [m/s] in the world frame and ``rate`` (3,) [rad/s] in the robot's.
    """

    position: Array
    rotation: Array
    velocity: Array
    rate: Array

    def plus(self, error: Array) -> RobotState:
        """The state perturbed by an error (12,)."""
        return RobotState(
            self.position + self.rotation @ error[SHIFT],
            orthonormal(self.rotation @ exp(error[TURN])),
            self.velocity + error[VELOCITY],
            self.rate + error[RATE],
        )

    def minus(self, other: RobotState) -> Array:
        """The error (12,) of this state relative to ``other``."""
        turn = log(other.rotation.T @ self.rotation)
        shift = other.rotation.T @ (self.position - other.position)
        return np.concatenate((turn, shift, self.velocity - other.velocity, self.rate - other.rate))


@dataclass(frozen=True)
class Step:
    """A prediction: the resulting ``robot``, the ``transition`` (12, 12 + P) of its error and that of P constants of what measures
    motion, the added ``noise`` (12, 12), and the variances ``drift`` (P,) by which constants change at random, if they do.
    """

    robot: RobotState
    transition: Array
    noise: Array
    drift: Array = field(default_factory=lambda: np.zeros(0))

    def carried(self, covariance: Array) -> Array:
        """The ``covariance`` (12 + P + D, 12 + P + D) of an error state, of which others are constant."""
        known = self.transition.shape[1]
        carried = self.transition @ covariance[:known]
        found = covariance.copy()
        found[:ROBOT] = carried
        found[ROBOT:, :ROBOT] = carried[:, ROBOT:].T
        corner = carried[:, :known] @ self.transition.T + self.noise
        found[:ROBOT, :ROBOT] = 0.5 * (corner + corner.T)
        changing = np.arange(ROBOT, ROBOT + len(self.drift))
        found[changing, changing] += self.drift
        return found

    def then(self, transition: Array, noise: Array, robot: RobotState) -> Step:
        """This step followed by another, of the robot alone."""
        return Step(robot, transition @ self.transition, transition @ self.noise @ transition.T + noise, self.drift)


@dataclass(frozen=True)
class Displacement:
    """Motion in space: ``rotation`` (3, 3) and ``shift`` (3,) of the end in the frame of the start, with ``covariance`` (6, 6) of
    a perturbation at the end, rotation first, and the derivative ``by_constants`` (6, P) of that perturbation by constants.
    """

    rotation: Array
    shift: Array
    covariance: Array
    by_constants: Array = field(default_factory=lambda: np.zeros((6, 0)))


@dataclass(frozen=True)
class Origin:
    """The start of a run without a map: ``robot`` then, the covariance (6, 6) of its pose, common to all later poses, and the
    standard deviation of the ``scale`` of all distances from it, relative to 1."""

    robot: RobotState
    covariance: Array
    scale: float = 0.0

    def of_pose(self, robot: RobotState) -> Array:
        """Its contribution to the covariance (6, 6) of a later pose."""
        turn = robot.rotation.T @ self.robot.rotation
        back = robot.rotation.T @ (self.robot.position - robot.position)
        adjoint = np.zeros((6, 6))
        adjoint[TURN, TURN] = adjoint[SHIFT, SHIFT] = turn
        adjoint[SHIFT, TURN] = cross(back) @ turn
        spread = adjoint @ self.covariance @ adjoint.T
        spread[SHIFT, SHIFT] += self.scale**2 * np.outer(back, back)
        return spread

    def of_point(self, point: Array) -> Array:
        """Its contribution to the covariance (3, 3) of a ``point`` (3,)."""
        rotation = self.robot.rotation
        jacobian = rotation @ np.column_stack((-cross(rotation.T @ (point - self.robot.position)), np.eye(3)))
        away = point - self.robot.position
        return np.asarray(jacobian @ self.covariance @ jacobian.T + self.scale**2 * np.outer(away, away))


def unobservable(robot: RobotState, *, floor: bool, gravity: bool) -> Array:
    """The projection (6, 6) of errors of a pose on those that nothing tells of without a map. A ``floor`` tells height, roll and
    pitch, ``gravity`` roll and pitch."""
    free = np.eye(6)
    if floor:
        free[UPRIGHT, UPRIGHT] = 0.0
    elif gravity:
        free[TURN, TURN] = np.outer(robot.rotation[2], robot.rotation[2])  # about the vertical
    return free


def standstill(robot: RobotState) -> Step:
    """The step of no motion, to a second measurement at the same time."""
    return Step(robot, np.eye(ROBOT), np.zeros((ROBOT, ROBOT)))


def constant_velocity(robot: RobotState, dt: float, impulse: Array, angular_impulse: Array) -> Step:
    """Motion at constant velocity over ``dt``; ``impulse``, ``angular_impulse`` (3,): standard deviations of the change of
    velocity and turn rate at its beginning.
    """
    turned = exp(robot.rate * dt)
    rotation = orthonormal(robot.rotation @ turned)
    by_rate = dt * np.asarray(gtsam.Rot3.ExpmapDerivative(robot.rate * dt))
    transition = np.eye(ROBOT)
    transition[TURN, TURN] = transition[SHIFT, SHIFT] = turned.T
    transition[TURN, RATE] = by_rate
    transition[SHIFT, VELOCITY] = dt * rotation.T
    spread = np.concatenate((impulse, angular_impulse)) ** 2
    noise = (transition[:, 6:] * spread) @ transition[:, 6:].T
    moved = RobotState(robot.position + robot.velocity * dt, rotation, robot.velocity, robot.rate)
    return Step(moved, transition, noise)


def measured(robot: RobotState, motion: Displacement, dt: float) -> Step:
    """Motion that was measured over ``dt``; it replaces velocity and turn rate, and their noise (reading 4 of the paper)."""
    dt = max(dt, SHORTEST)
    rotation = orthonormal(robot.rotation @ motion.rotation)
    transition, by_noise = np.zeros((ROBOT, ROBOT)), np.zeros((ROBOT, 6))
    transition[TURN, TURN] = transition[SHIFT, SHIFT] = motion.rotation.T
    transition[SHIFT, TURN] = -motion.rotation.T @ cross(motion.shift)
    transition[VELOCITY, TURN] = -robot.rotation @ cross(motion.shift) / dt
    by_noise[:6] = np.eye(6)
    by_noise[VELOCITY, SHIFT] = rotation / dt
    by_noise[RATE, TURN] = np.eye(3) / dt
    way = robot.rotation @ motion.shift
    moved = RobotState(robot.position + way, rotation, way / dt, log(motion.rotation) / dt)
    return Step(
        moved, np.hstack((transition, by_noise @ motion.by_constants)), by_noise @ motion.covariance @ by_noise.T
    )


def planar(delta: Array, covariance: Array, by_constants: Array) -> Displacement:
    """Odometry of a robot on the floor, as motion in space: ``delta`` (3,) with ``covariance`` (3, 3) and the derivative
    ``by_constants`` (3, P).
    """
    x, y, heading = delta.tolist()
    spread, derivative = np.zeros((6, 6)), np.zeros((6, by_constants.shape[1]))
    spread[np.ix_(PLANAR, PLANAR)] = covariance
    derivative[PLANAR] = by_constants
    return Displacement(about_z(heading), np.array((x, y, 0.0)), spread, derivative)


def on_the_floor(step: Step, dt: float, height_sigma: float, tilt_sigma: float, settling: float) -> Step:
    """A step of a robot on the floor: height, roll and pitch follow a stationary process about zero with these standard
    deviations and the time constant ``settling`` [s], and have no velocity. For small tilts.
    """
    keep = math.exp(-dt / settling)
    robot = step.robot
    heading = heading_of(robot)
    rotation = heading @ exp(keep * log(heading.T @ robot.rotation))
    position = np.array((robot.position[0], robot.position[1], keep * robot.position[2]))
    velocity = np.array((robot.velocity[0], robot.velocity[1], 0.0))
    rate = np.array((0.0, 0.0, robot.rate[2]))
    transition, noise = np.eye(ROBOT), np.zeros((ROBOT, ROBOT))
    sigmas = np.array((tilt_sigma, tilt_sigma, height_sigma))
    transition[UPRIGHT, UPRIGHT] = keep
    transition[NO_VELOCITY, NO_VELOCITY] = 0.0
    noise[UPRIGHT, UPRIGHT] = (1.0 - keep**2) * sigmas**2
    noise[NO_VELOCITY, NO_VELOCITY] = np.square((height_sigma, tilt_sigma, tilt_sigma)) / settling**2
    return step.then(transition, noise, RobotState(position, rotation, velocity, rate))


def heading_of(robot: RobotState) -> Array:
    """The rotation (3, 3) of a level robot with the same heading."""
    return about_z(math.atan2(robot.rotation[1, 0], robot.rotation[0, 0]))


def tilt_of(robot: RobotState) -> Array:
    """Roll and pitch (2,) [rad] of a robot that is nearly level."""
    return log(heading_of(robot).T @ robot.rotation)[:2]


class Chain(ABC):
    """Rows (6,) of a sensor of motion in space. ``horizon``: seconds of rows that are kept."""

    def __init__(self, horizon: float = math.inf) -> None:
        self._horizon = horizon
        self._t: list[float] = []
        self._rows: list[Array] = []

    @abstractmethod
    def take(self, m: Measurement) -> bool | None:
        """Take the row of a measurement, see :meth:`add`; None if it is of another sensor."""

    def add(self, t: float, row: Array) -> bool:
        """Add a row; False if it is older than the newest, whose motion was used already."""
        if self._t and t < self._t[-1]:
            return False
        self._t.append(t)
        self._rows.append(row)
        old = bisect.bisect_left(self._t, t - self._horizon) - 1
        if old > 0:
            del self._t[:old], self._rows[:old]
        return True

    def parts(self, start: float, end: float) -> Iterator[tuple[int, float, float]]:
        """The parts from ``start`` to ``end`` between rows: the number of the row before, or -1, and when each begins and ends."""
        first, last = bisect.bisect_right(self._t, start), bisect.bisect_left(self._t, end)
        for k, (a, b) in enumerate(pairwise([start, *self._t[first:last], end])):
            yield first - 1 + k, a, b


class TwistChain(Chain):
    """Integrates measured velocities, and turn rates, to the motion between two times."""

    def __init__(self, settings: TwistSettings, horizon: float = math.inf) -> None:
        super().__init__(horizon)
        self._spread = np.square((*settings.turn, *settings.shift))

    def take(self, m: Measurement) -> bool | None:
        twist = in_space(m)
        return None if twist is None else self.add(twist.t, np.concatenate((twist.v, twist.w)))

    def between(self, start: float, end: float) -> Displacement:
        """The motion from ``start`` to ``end``; a velocity is held until the next row, for at most :data:`HOLD`."""
        rotation, shift, covariance = np.eye(3), np.zeros(3), np.zeros((6, 6))
        for row, a, b in self.parts(start, end):
            held = b - a if row >= 0 and b - self._t[row] <= HOLD else 0.0
            v, w = np.split(self._rows[row] if held else np.zeros(6), 2)
            turned = exp(w * (b - a))
            moved = exp(w * (0.5 * (b - a))) @ v * (b - a)
            transition = np.zeros((6, 6))
            transition[TURN, TURN] = transition[SHIFT, SHIFT] = turned.T
            transition[SHIFT, TURN] = -turned.T @ cross(moved)
            covariance = transition @ covariance @ transition.T
            spread = self._spread if held else np.full(6, UNKNOWN**2)
            covariance[np.diag_indices(6)] += spread * (b - a)
            shift, rotation = shift + rotation @ moved, rotation @ turned
        return Displacement(orthonormal(rotation), shift, covariance)


def exp(turn: Array) -> Array:
    """The rotation (3, 3) of a rotation vector (3,)."""
    return np.asarray(gtsam.Rot3.Expmap(turn).matrix())


def log(rotation: Array) -> Array:
    """The rotation vector (3,) of a rotation (3, 3)."""
    return np.asarray(gtsam.Rot3.Logmap(gtsam.Rot3(rotation)))


def about_z(angle: float) -> Array:
    """The rotation (3, 3) by ``angle`` [rad] about z."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))


def cross(v: Array) -> Array:
    """The matrix (3, 3) of the cross product with ``v`` (3,)."""
    x, y, z = v.tolist()
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def orthonormal(rotation: Array) -> Array:
    """A rotation (3, 3) with the accumulated rounding errors removed."""
    return np.asarray(rotation @ (1.5 * np.eye(3) - 0.5 * rotation.T @ rotation))
