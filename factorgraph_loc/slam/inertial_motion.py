"""Motion that an inertial unit measures: GTSAM's preintegration (Forster, Carlone, Dellaert, Scaramuzza, "On-manifold
preintegration for real-time visual-inertial odometry", IEEE Transactions on Robotics 33(1), 2017), in graphs and in the filter.

Beside a pose there are a velocity and six biases, of force and of turn rate, that change at random. The filter's prediction is the
graph's factor, linearised where it has no error. The world's z axis points up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.settings import Estimated
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.inertial.measurement import inertial as row_of
from factorgraph_loc.sensors.inertial.measurement import inertial_settings
from factorgraph_loc.sensors.inertial.settings import InertialSettings
from factorgraph_loc.sensors.twist.measurement import twist_settings
from factorgraph_loc.slam.space_motion import RATE, ROBOT, SHORTEST, Chain, RobotState, Step, TwistChain
from factorgraph_loc.slam.space_motion_models import KnownState, MeasuredMotion, SpaceMotion, pose_of, robot_of
from factors import positive
from factors.se2 import Array

STRIDE = 1 << 32  # between the keys of a pose, of its velocity, and of its biases
BIASES = tuple(f"{what}_bias_{axis}" for what in ("force", "turn") for axis in "xyz")
MOVING = np.r_[0:9, ROBOT : ROBOT + 6]  # pose, velocity and biases in the error state
HOLD = 0.1  # s, for which a row is held
UNIT = np.eye(3)
UNKNOWN_FORCE, UNKNOWN_TURN = 5.0, 1.0  # densities [m/s^2, rad/s per sqrt(Hz)] of the noise where there are no rows


class InertialChain(Chain):
    """Integrates force and turn rate, linear between rows, from one time to another.

    What a unit away from the robot's origin feels of its turning is taken off, by GTSAM or, of a changing turn rate, here.
    """

    def __init__(self, settings: InertialSettings, horizon: float = math.inf) -> None:
        super().__init__(horizon)
        self._densities = settings.force_noise, settings.turn_noise
        self._params = gtsam.PreintegrationParams.MakeSharedU(settings.gravity)
        turn = gtsam.Rot3.Ypr(settings.yaw, settings.pitch, settings.roll)
        position = np.array((settings.x, settings.y, settings.z))
        self._arm = turn.unrotate(position)
        self._params.setBodyPSensor(gtsam.Pose3(turn, position))

    def take(self, m: Measurement) -> bool | None:
        row = row_of(m)
        return None if row is None else self.add(row.t, row.values())

    def between(self, start: float, end: float, biases: Array) -> gtsam.PreintegratedImuMeasurements:
        """The motion from ``start`` to ``end``, with ``biases`` (6,) near the true ones."""
        found = gtsam.PreintegratedImuMeasurements(self._params, bias_of(biases))
        parts = [(row, a, b) for row, a, b in self.parts(start, end) if b > a]
        if not parts:
            return found
        rows, begins, ends = (np.array(column) for column in zip(*parts, strict=True))
        dt = (ends - begins)[:, None]
        first, last = self._at(rows, begins), self._at(rows, ends)
        force, turn = np.split(0.5 * (first + last), 2, axis=1)
        force = force - np.cross((last - first)[:, 3:] / dt, self._arm)
        # GTSAM takes the axes to be those of the part's beginning
        force = force + 0.5 * dt * np.cross(turn, force - np.cross(turn, np.cross(turn, self._arm)))
        for (row, a, b), mean_force, mean_turn in zip(parts, force, turn, strict=True):
            held = row >= 0 and b - self._t[row] <= HOLD
            by_force, by_turn = self._densities if held else (UNKNOWN_FORCE, UNKNOWN_TURN)
            self._params.setAccelerometerCovariance(by_force**2 * UNIT)
            self._params.setGyroscopeCovariance(by_turn**2 * UNIT)
            # what white noise within the part adds to the position, beside that of its mean
            self._params.setIntegrationCovariance((by_force * (b - a)) ** 2 / 12.0 * UNIT)
            found.integrateMeasurement(mean_force, mean_turn, b - a)
        return found

    def _at(self, rows: NDArray[np.int64], t: Array) -> Array:
        """Force and turn rate (N, 6) at times ``t`` (N,), each after one of ``rows`` (N,), which ascend."""
        if not self._rows:
            return np.zeros((len(t), 6))
        begin, end = max(rows[0], 0), rows[-1] + 2
        times, values = np.array(self._t[begin:end]), np.array(self._rows[begin:end])
        before = np.maximum(rows - begin, 0)
        after = np.minimum(before + 1, len(times) - 1)
        share = np.clip((t - times[before]) / np.maximum(times[after] - times[before], SHORTEST), 0.0, 1.0)[:, None]
        return np.asarray((1.0 - share) * values[before] + share * values[after])


class InertialMotion(SpaceMotion):
    """Motion as an inertial unit measures it."""

    def __init__(self, chain: InertialChain, settings: InertialSettings) -> None:
        self._chain = chain
        self.constants = Estimated(BIASES, tuple(range(6)), np.repeat((settings.force_bias, settings.turn_bias), 3))
        self._walk = np.repeat((settings.force_walk, settings.turn_walk), 3)

    def step(self, known: KnownState, end: float) -> Step:
        motion, bias = self._chain.between(known.t, end, known.constants), bias_of(known.constants)
        here = gtsam.NavState(pose_of(known.robot), known.robot.velocity)
        there = motion.predict(here, bias)
        robot = RobotState(there.position(), there.attitude().matrix(), there.velocity(), np.zeros(3))
        values = self.values(0, known)
        values.insert(1, there.pose())
        values.insert(1 + STRIDE, there.velocity())
        # by pose and velocity, here and there, and biases
        jacobian, _ = _factor(0, 1, motion).linearize(values).jacobian()
        back = np.linalg.inv(jacobian[:, 9:18])
        transition, noise = np.zeros((ROBOT, ROBOT + 6)), np.zeros((ROBOT, ROBOT))
        transition[:9, MOVING] = -back @ np.delete(jacobian, np.s_[9:18], axis=1)
        noise[:9, :9] = back @ back.T
        noise[RATE, RATE] = np.eye(3)  # which nothing depends on
        return Step(robot, transition, noise, self._walk**2 * (end - known.t))

    def factors(self, keys: Sequence[int], times: Sequence[float], start: KnownState) -> list[gtsam.NonlinearFactor]:
        (*_, i, j), (*_, begin, end) = keys, times
        motion = self._chain.between(begin, end, start.constants)
        walk = gtsam.noiseModel.Diagonal.Sigmas(self._walk * math.sqrt(end - begin))
        return [
            _factor(i, j, motion),
            gtsam.BetweenFactorConstantBias(i + 2 * STRIDE, j + 2 * STRIDE, gtsam.imuBias.ConstantBias(), walk),
        ]

    def state(
        self, values: gtsam.Values, keys: Sequence[int], spread: Array, times: Sequence[float], start: KnownState
    ) -> KnownState:
        key, covariance = keys[-1], np.eye(ROBOT + 6)
        covariance[np.ix_(MOVING, MOVING)] = spread
        still = robot_of(values.atPose3(key))
        robot = RobotState(still.position, still.rotation, values.atVector(key + STRIDE), np.zeros(3))
        return KnownState(times[-1], robot, covariance, values.atConstantBias(key + 2 * STRIDE).vector())

    def joint(self, keys: Sequence[int]) -> list[int]:
        return list(self.sizes(keys[-1]))

    def sizes(self, key: int) -> dict[int, int]:
        return {key: 6, key + STRIDE: 3, key + 2 * STRIDE: 6}

    def values(self, key: int, known: KnownState) -> gtsam.Values:
        found = super().values(key, known)
        found.insert(key + STRIDE, known.robot.velocity)
        found.insert(key + 2 * STRIDE, bias_of(known.constants))
        return found

    def prior(self, key: int, known: KnownState) -> gtsam.NonlinearFactor:
        whitener = positive.whitener(known.covariance[np.ix_(MOVING, MOVING)])
        parts = np.split(whitener, (6, 9), axis=1)
        pose, velocity, bias = zip(self.sizes(key), parts, strict=True)
        unit = gtsam.noiseModel.Unit.Create(len(MOVING))
        linear = gtsam.JacobianFactor(*pose, *velocity, *bias, np.zeros(len(MOVING)), unit)
        return gtsam.LinearContainerFactor(linear, self.values(key, known))


def _factor(i: int, j: int, motion: gtsam.PreintegratedImuMeasurements) -> gtsam.NonlinearFactor:
    """The motion as a factor on two poses, their velocities, and the biases of the first."""
    return gtsam.ImuFactor(i, i + STRIDE, j, j + STRIDE, i + 2 * STRIDE, motion)


def bias_of(constants: Array) -> gtsam.imuBias.ConstantBias:
    """The biases (6,) of force and turn rate, for GTSAM."""
    return gtsam.imuBias.ConstantBias(constants[:3], constants[3:])


def measured_motion(
    setup: Setup, horizon: float = math.inf, *, inertial: bool = True
) -> tuple[Chain | None, SpaceMotion | None]:
    """The rows, of the last ``horizon`` seconds, of what measures motion in space, and the motion; or nothing. ``inertial``:
    whether it may be an inertial unit."""
    twist, unit = twist_settings(setup), inertial_settings(setup)
    if twist is not None:
        chain = TwistChain(twist, horizon)
        return chain, MeasuredMotion(chain)
    if unit is not None and inertial:
        rows = InertialChain(unit, horizon)
        return rows, InertialMotion(rows, unit)
    return None, None
