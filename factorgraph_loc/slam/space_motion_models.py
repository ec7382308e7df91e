"""Motion in space as factors of a graph: measured, or with a velocity that changes at random.

In these a velocity is no variable: between two poses it is their difference over the time between them, as in the filter that
predicts by it (:func:`~factorgraph_loc.slam.space_motion.constant_velocity`). It is one in :mod:`.inertial_motion`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import gtsam
import numpy as np

from factorgraph_loc.model.settings import NOTHING, Estimated
from factorgraph_loc.slam.space_motion import (
    POSES,
    ROBOT,
    SHIFT,
    TURN,
    VELOCITIES,
    RobotState,
    Step,
    TwistChain,
    constant_velocity,
    log,
    measured,
)
from factors import positive
from factors.se2 import Array

AT_ONCE = 1e-3  # s between stamps of one pose: from less no velocity can be computed


@dataclass(frozen=True)
class KnownState:
    """What is known of the robot and of P ``constants`` (P,) at ``t`` [s]: their mean, and the covariance (12 + P, 12 + P) of the
    error state of the filter."""

    t: float
    robot: RobotState
    covariance: Array
    constants: Array = field(default_factory=lambda: np.zeros(0))

    def moved(self, step: Step, t: float) -> KnownState:
        """What is known at ``t``, after that step."""
        return KnownState(t, step.robot, step.carried(self.covariance), self.constants)

    def by_pose(self) -> tuple[Array, Array]:
        """How the expected velocities depend on the error of the pose (6, 6), and their covariance (6, 6) if that is known."""
        gain = positive.solve(self.covariance[POSES, POSES], self.covariance[POSES, VELOCITIES]).T
        return gain, self.covariance[VELOCITIES, VELOCITIES] - gain @ self.covariance[POSES, VELOCITIES]


class SpaceMotion(ABC):
    """A model of how the robot moves.

    ``by_velocity``: whether it moves on by the velocity it has. ``constants``: of what measures the motion, which change at
    random. In a graph a pose has its number as key; a model may have further variables beside each.
    """

    by_velocity: ClassVar[bool] = True
    constants: Estimated = NOTHING

    @abstractmethod
    def step(self, known: KnownState, end: float) -> Step:
        """Where the robot is at ``end``."""

    @abstractmethod
    def factors(self, keys: Sequence[int], times: Sequence[float], start: KnownState) -> list[gtsam.NonlinearFactor]:
        """The factors on the last of the poses ``keys`` and one or two before; ``start``: what is known of the first of all."""

    @abstractmethod
    def state(
        self, values: gtsam.Values, keys: Sequence[int], spread: Array, times: Sequence[float], start: KnownState
    ) -> KnownState:
        """What is known at the last of one or two poses ``keys``; ``spread``: the joint covariance of :meth:`joint`."""

    def joint(self, keys: Sequence[int]) -> list[int]:
        """The variables that :meth:`state` needs the joint covariance of, in order of their keys."""
        return list(keys)

    def sizes(self, key: int) -> dict[int, int]:
        """The variables of a pose, and how many values their errors have."""
        return {key: 6}

    def values(self, key: int, known: KnownState) -> gtsam.Values:
        """The variables of a pose, as they are known."""
        found = gtsam.Values()
        found.insert(key, pose_of(known.robot))
        return found

    def prior(self, key: int, known: KnownState) -> gtsam.NonlinearFactor:
        """The prior factor on the variables of a pose."""
        noise = gtsam.noiseModel.Gaussian.Covariance(known.covariance[POSES, POSES])
        return gtsam.PriorFactorPose3(key, pose_of(known.robot), noise)


class MeasuredMotion(SpaceMotion):
    """Motion as a ``twist`` measures it."""

    by_velocity = False

    def __init__(self, chain: TwistChain) -> None:
        self._chain = chain

    def step(self, known: KnownState, end: float) -> Step:
        return measured(known.robot, self._chain.between(known.t, end), end - known.t)

    def factors(self, keys: Sequence[int], times: Sequence[float], start: KnownState) -> list[gtsam.NonlinearFactor]:
        by = self._chain.between(times[-2], times[-1])
        moved, noise = gtsam.Pose3(gtsam.Rot3(by.rotation), by.shift), gtsam.noiseModel.Gaussian.Covariance
        return [gtsam.BetweenFactorPose3(keys[-2], keys[-1], moved, noise(by.covariance))]

    def state(
        self, values: gtsam.Values, keys: Sequence[int], spread: Array, times: Sequence[float], start: KnownState
    ) -> KnownState:
        covariance = np.zeros((ROBOT, ROBOT))
        covariance[POSES, POSES] = spread[-6:, -6:]
        return KnownState(times[-1], robot_of(values.atPose3(keys[-1])), covariance)


class ConstantVelocity(SpaceMotion):
    """A velocity and a turn rate that are constant but for an impulse at each step, as in the filter.

    ``acceleration`` [m/s^2], ``angular`` [rad/s^2]: standard deviations of what acts over a step (Davison et al., 2007, section
    III.D).
    """

    def __init__(self, acceleration: float, angular: float) -> None:
        self._sigmas = np.repeat((acceleration, angular), 3)

    def step(self, known: KnownState, end: float) -> Step:
        impulse = self._sigmas * (end - known.t)
        return constant_velocity(known.robot, end - known.t, impulse[:3], impulse[3:])

    def factors(self, keys: Sequence[int], times: Sequence[float], start: KnownState) -> list[gtsam.NonlinearFactor]:
        spans = np.diff(times)
        impulse = np.diag(np.square(self._sigmas * spans[-1]))
        gain, rest = start.by_pose() if len(keys) == 2 else (np.empty(0), np.zeros((6, 6)))
        noise = gtsam.noiseModel.Gaussian.Covariance(rest + impulse)

        def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
            poses = [values.atPose3(key) for key in keys]
            found, *by = velocities(poses[-2], poses[-1], spans[-1])
            if len(keys) > 2:
                before, by_first, by_second = velocities(poses[0], poses[1], spans[0])
                by = [-by_first, by[0] - by_second, by[1]]
            else:
                off = start.robot
                before = np.concatenate((off.velocity, off.rate)) + gain @ robot_of(poses[0]).minus(off)[POSES]
                by[0] = by[0] - gain
            if jacobians is not None:
                for i, jacobian in enumerate(by):
                    jacobians[i] = jacobian
            return found - before

        return [gtsam.CustomFactor(noise, list(keys), error)]

    def state(
        self, values: gtsam.Values, keys: Sequence[int], spread: Array, times: Sequence[float], start: KnownState
    ) -> KnownState:
        poses = [values.atPose3(key) for key in keys]
        robot, covariance = robot_of(poses[-1]), np.zeros((ROBOT, ROBOT))
        if len(poses) > 1:
            found, by_first, by_second = velocities(poses[0], poses[1], times[-1] - times[-2])
            lift = np.block([[np.zeros((6, 6)), np.eye(6)], [by_first, by_second]])
        else:
            gain, rest = start.by_pose()
            found = np.concatenate((start.robot.velocity, start.robot.rate)) + gain @ robot.minus(start.robot)[POSES]
            lift = np.vstack((np.eye(6), gain))
            covariance[VELOCITIES, VELOCITIES] = rest
        moving = RobotState(robot.position, robot.rotation, found[:3], found[3:])
        return KnownState(times[-1], moving, lift @ spread @ lift.T + covariance)


def velocities(first: gtsam.Pose3, second: gtsam.Pose3, dt: float) -> tuple[Array, Array, Array]:
    """Velocity in the world and turn rate in the robot's frame (6,) between two poses, and their derivatives (6, 6) by the
    perturbation of each."""
    here, there = robot_of(first), robot_of(second)
    turned = here.rotation.T @ there.rotation
    angle = log(turned)
    by_turn = np.asarray(gtsam.Rot3.LogmapDerivative(angle))
    by_first, by_second = np.zeros((6, 6)), np.zeros((6, 6))
    by_first[:3, SHIFT], by_second[:3, SHIFT] = -here.rotation, there.rotation
    by_first[3:, TURN], by_second[3:, TURN] = -by_turn @ turned.T, by_turn
    return np.concatenate((there.position - here.position, angle)) / dt, by_first / dt, by_second / dt


def robot_of(pose: gtsam.Pose3) -> RobotState:
    """A robot at rest at a pose."""
    return RobotState(np.asarray(pose.translation()), np.asarray(pose.rotation().matrix()), np.zeros(3), np.zeros(3))


def pose_of(robot: RobotState) -> gtsam.Pose3:
    """The pose of a robot."""
    return gtsam.Pose3(gtsam.Rot3(robot.rotation), robot.position)
