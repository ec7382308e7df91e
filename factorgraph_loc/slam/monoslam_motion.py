"""The motion model of the monoSLAM filter. Odometry predicts x, y and heading; the floor bounds height, roll and pitch.

The state is as in Davison, Reid, Molton, Stasse, "MonoSLAM: real-time single camera SLAM", IEEE Transactions on
Pattern Analysis and Machine Intelligence 29(6), 2007. The error state has 12 values. The first six are rotation (3,)
and translation (3,) of the pose in the robot's frame, as in ``gtsam.Pose3``. The velocity (3,) in the world frame and
the turn rate (3,) in the robot's frame follow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from factors.camera.model import PLANAR
from factors.se2 import Array

ROBOT = 12  # number of values of the robot's error state
TURN, SHIFT, VELOCITY, RATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
UPRIGHT = [0, 1, 5]  # the components bounded by the floor: roll, pitch, height
NO_VELOCITY = [8, 9, 10]  # the velocities of height, roll and pitch
# s: time constants of roll, pitch and height if the standard deviation of the tilt is fixed, and if it is estimated.
SETTLING, UNEVEN = 1.0, 3.0
SHORTEST = 1e-3  # s, shortest interval for the computation of a velocity


@dataclass(frozen=True)
class RobotState:
    """Pose and velocity of a robot in space.

    In the world frame: ``position`` (3,) [m], ``rotation`` (3, 3) from robot to world, ``velocity`` (3,) [m/s].
    In the robot's frame: ``rate`` (3,), the turn rate [rad/s].
    """

    position: Array
    rotation: Array
    velocity: Array
    rate: Array

    def plus(self, error: Array) -> RobotState:
        """Return the state perturbed by ``error`` (12,), in the order rotation, position, velocity, turn rate."""
        return RobotState(
            self.position + self.rotation @ error[SHIFT],
            orthonormal(self.rotation @ exp(error[TURN])),
            self.velocity + error[VELOCITY],
            self.rate + error[RATE],
        )

    def minus(self, reference: RobotState) -> Array:
        """Return the error (12,) of this state relative to ``reference``: rotation, position, velocity, turn rate. The
        method :meth:`plus` of ``reference`` converts this error to this state."""
        turn = log(reference.rotation.T @ self.rotation)
        shift = reference.rotation.T @ (self.position - reference.position)
        return np.concatenate((turn, shift, self.velocity - reference.velocity, self.rate - reference.rate))


@dataclass(frozen=True)
class Step:
    """A prediction of the filter from one time to a later one.

    ``robot``: the predicted state. ``transition`` (12, 12 + P): the Jacobian of its error with respect to the error of
    the earlier state and of the P constants of the odometry. ``noise`` (12, 12): the covariance that the motion adds.
    """

    robot: RobotState
    transition: Array
    noise: Array

    def carried(self, covariance: Array) -> Array:
        """Return the covariance after the step. ``covariance`` (12 + P + D, 12 + P + D): the covariance before it. P is
        the number of constants of the odometry, and D the number of values of points."""
        known = self.transition.shape[1]
        carried = self.transition @ covariance[:known]
        result = covariance.copy()
        result[:ROBOT] = carried
        result[ROBOT:, :ROBOT] = carried[:, ROBOT:].T
        corner = carried[:, :known] @ self.transition.T + self.noise
        result[:ROBOT, :ROBOT] = 0.5 * (corner + corner.T)
        return result

    def then(self, transition: Array, noise: Array, robot: RobotState) -> Step:
        """Return one step that is this step followed by another. ``transition``, ``noise`` (12, 12): of the other step,
        which must not depend on the constants of the odometry. ``robot``: the state after the other step."""
        return Step(robot, transition @ self.transition, transition @ self.noise @ transition.T + noise)


@dataclass(frozen=True)
class Origin:
    """The start of a run without a map. Its uncertainty is not in the filter's state, but is added to estimates.
    ``robot``: the state at the start. ``covariance`` (6, 6): the covariance of the start pose, in the robot's frame."""

    robot: RobotState
    covariance: Array

    def of_pose(self, robot: RobotState) -> Array:
        """Return the covariance (6, 6) that the uncertain start pose adds to the later pose in ``robot``."""
        turn = robot.rotation.T @ self.robot.rotation
        back = robot.rotation.T @ (self.robot.position - robot.position)
        adjoint = np.zeros((6, 6))
        adjoint[TURN, TURN] = adjoint[SHIFT, SHIFT] = turn
        adjoint[SHIFT, TURN] = cross(back) @ turn
        return np.asarray(adjoint @ self.covariance @ adjoint.T)

    def of_point(self, point: Array) -> Array:
        """Return the covariance (3, 3) that the uncertain start pose adds to a ``point`` (3,) in the world frame."""
        rotation = self.robot.rotation
        jacobian = rotation @ np.column_stack((-cross(rotation.T @ (point - self.robot.position)), np.eye(3)))
        return np.asarray(jacobian @ self.covariance @ jacobian.T)


def standstill(robot: RobotState) -> Step:
    """Return a prediction step without motion. It is used between two measurements at the same time."""
    return Step(robot, np.eye(ROBOT), np.zeros((ROBOT, ROBOT)))


def measured(robot: RobotState, delta: Array, covariance: Array, by_constants: Array, dt: float) -> Step:
    """Return the prediction step of a robot that moves as measured by odometry, with the odometry's velocity.

    ``robot``: the state at the start. ``delta`` (3,): pose of the end in the frame of the start, as x [m], y [m],
    heading [rad]. ``covariance`` (3, 3): of a perturbation of the end in its own frame. ``by_constants`` (3, P): the
    derivative of this perturbation by the P constants of the odometry. ``dt`` [s]: the duration.
    """
    dt = max(dt, SHORTEST)
    turn, ahead = about_z(float(delta[2])), np.array((delta[0], delta[1], 0.0))
    rotation = orthonormal(robot.rotation @ turn)
    transition, by_noise = np.zeros((ROBOT, ROBOT)), np.zeros((ROBOT, 6))
    transition[TURN, TURN] = transition[SHIFT, SHIFT] = turn.T
    transition[SHIFT, TURN] = -turn.T @ cross(ahead)
    transition[VELOCITY, TURN] = -robot.rotation @ cross(ahead) / dt
    by_noise[:6] = np.eye(6)
    by_noise[VELOCITY, SHIFT] = rotation / dt
    by_noise[RATE, TURN] = np.eye(3) / dt
    by_noise = by_noise[:, PLANAR]
    shift = robot.rotation @ ahead
    moved = RobotState(robot.position + shift, rotation, shift / dt, log(turn) / dt)
    return Step(moved, np.hstack((transition, by_noise @ by_constants)), by_noise @ covariance @ by_noise.T)


def on_the_floor(step: Step, dt: float, height_sigma: float, tilt_sigma: float, settling: float) -> Step:
    """Return the prediction ``step`` of a robot on a floor, which tilts only slightly. Height, roll and pitch decay
    towards zero.

    They are a stationary process with mean zero and without velocity. ``height_sigma`` [m] and ``tilt_sigma`` [rad] are
    its standard deviations, ``settling`` [s] its time constant. ``dt`` [s]: the duration of ``step``.
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
    """Return the rotation (3, 3) of a level robot with the same heading as ``robot``."""
    return about_z(math.atan2(robot.rotation[1, 0], robot.rotation[0, 0]))


def seen_from_above(robot: RobotState, covariance: Array) -> tuple[Array, Array]:
    """Return the planar pose (3,) of a robot, as x, y and heading, and its covariance (3, 3). ``covariance`` (6, 6):
    the covariance of the robot's pose in space, in the robot's frame."""
    rotation = robot.rotation
    x, y = rotation[0, 0], rotation[1, 0]
    jacobian = np.zeros((3, 6))
    jacobian[:2, 3:] = rotation[:2]
    # a small rotation (a, b, c) moves the robot's x axis by c times its y axis minus b times its z axis
    across = np.array((-y, x)) / max(x * x + y * y, 1e-12)
    jacobian[2, 1], jacobian[2, 2] = -across @ rotation[:2, 2], across @ rotation[:2, 1]
    pose: Array = np.array((robot.position[0], robot.position[1], np.arctan2(y, x)))
    return pose, jacobian @ covariance @ jacobian.T


def tilt_of(robot: RobotState) -> Array:
    """Return roll and pitch (2,) [rad] of a robot that is nearly level."""
    return log(heading_of(robot).T @ robot.rotation)[:2]


def exp(turn: Array) -> Array:
    """Return the rotation (3, 3) of the rotation vector ``turn`` (3,) [rad]."""
    return np.asarray(gtsam.Rot3.Expmap(turn).matrix())


def log(rotation: Array) -> Array:
    """Return the rotation vector (3,) of a rotation (3, 3)."""
    return np.asarray(gtsam.Rot3.Logmap(gtsam.Rot3(rotation)))


def about_z(angle: float) -> Array:
    """Return the rotation (3, 3) by ``angle`` [rad] about z."""
    return np.asarray(gtsam.Rot3.Yaw(angle).matrix())


def cross(v: Array) -> Array:
    """Return the matrix (3, 3) of the cross product with ``v`` (3,)."""
    x, y, z = v.tolist()
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def orthonormal(rotation: Array) -> Array:
    """Return the orthonormal matrix nearest to a ``rotation`` (3, 3) with rounding errors."""
    return np.asarray(rotation @ (1.5 * np.eye(3) - 0.5 * rotation.T @ rotation))
