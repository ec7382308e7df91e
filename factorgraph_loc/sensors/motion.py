"""Computes the motion of the robot from wheel odometry and gyro, during a run and for a whole log."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Measurement, Rows
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.settings import NOTHING
from factorgraph_loc.sensors.odometry.measurement import (
    IncrementOdometry,
    IncrementStream,
    VelocityOdometry,
    VelocityStream,
    YawRate,
)
from factorgraph_loc.sensors.odometry.settings import ImuSettings, OdometrySettings
from factors import se2
from factors.motion import ChainState, Increment
from factors.odometry import kernels
from factors.odometry.chain import OdometryChain
from factors.odometry.model import (
    PARAMETERS,
    OdometryModel,
    slip,
)
from factors.se2 import Array

MOTION = "motion"  # the state block with the calibration constants of the odometry
# distance [m], rotation [rad] and time [s] after which other sensors are assumed to correct the error of a constant
WAY, TURN, TIME = 4.0, 4.0, 8.0
HORIZON = 5.0  # s; older odometry is discarded during a run


def odometry_model(rig: Rig, *, use_gyro: bool = False, constants_as_noise: bool = False) -> OdometryModel:
    """Return the odometry model of a rig.

    ``use_gyro``: True if the gyro replaces the rotation of the wheels. The noise of the heading is then that of the
    gyro. ``constants_as_noise``: True to add the uncertainty of the calibration constants to the noise. Use this if the
    constants are not estimated. The added variances are exact after the distance :data:`WAY`, the rotation :data:`TURN`
    and the time :data:`TIME`.
    """
    s = rig.of(OdometrySettings)
    along, heading = s.noise.along.model(), s.noise.heading.model()
    if constants_as_noise:
        u = s.uncertainty
        along = along.widened(per_distance=u.scale_distance * math.sqrt(WAY))
        heading = heading.widened(
            per_distance=u.heading_drift * math.sqrt(WAY),
            per_rotation=u.scale_rotation * math.sqrt(TURN),
            per_time=u.heading_rate_bias * math.sqrt(TIME),
        )
    imu = rig.find(ImuSettings) or ImuSettings()
    return OdometryModel(
        scale_distance=s.scale_distance,
        scale_rotation=s.scale_rotation,
        speed_bias=s.speed_bias,
        heading_rate_bias=s.heading_rate_bias,
        heading_drift=s.heading_drift,
        direction=s.direction,
        delay=s.delay,
        lag=s.lag,
        turn_slowdown=s.turn_slowdown,
        gyro_bias=imu.bias,
        max_hold=s.max_hold,
        unknown_distance=s.unknown_distance,
        unknown_rotation=s.unknown_rotation,
        along=along,
        lateral=s.noise.lateral.model(),
        heading=imu.heading.model() if use_gyro else heading,
    )


class Motion(OdometryChain):
    """Collects rows of wheel odometry and gyro, and computes the relative motion between any two recent times.

    If ``sensors`` include "imu", the rotation is that of the gyro. ``self_calibration``: True to estimate the P
    calibration constants in the attribute ``constants``. Otherwise their uncertainty is part of the noise.
    """

    def __init__(
        self, rig: Rig, sensors: tuple[str, ...], diagnostics: Diagnostics, *, self_calibration: bool = False
    ) -> None:
        self.constants = rig.estimated("odometry") if self_calibration else NOTHING
        self._use_wheels, use_gyro = "odometry" in sensors, "imu" in sensors
        model = odometry_model(rig, use_gyro=use_gyro, constants_as_noise=not self_calibration)
        super().__init__(model, use_gyro=use_gyro, horizon=HORIZON, estimated=self.constants.indices)
        self._diagnostics = diagnostics

    def add(self, m: Measurement) -> None:
        """Add one measurement of odometry or gyro, or several as :class:`~factorgraph_loc.model.measurement.Rows`. Rows
        of sensors that are not used are counted as ignored in the diagnostics. Rows with times before the stored
        history are counted as late."""
        kept: int
        match m:
            case Rows(kind=kind) if kind is VelocityOdometry and self._use_wheels:
                kept = self.add_velocities(m.times, *m.values)
            case YawRate() if self._use_gyro:
                kept = self.add_yaw_rate(m.t, m.w)
            case VelocityOdometry() if self._use_wheels:
                kept = self.add_velocity(m.t, m.v, m.w)
            case IncrementOdometry() if self._use_wheels:
                kept = self.add_increment(m.t, m.dx, m.dy, m.dtheta, m.unknown)
            case _:
                self._diagnostics.ignore("yaw rate" if isinstance(m, YawRate) else m.sensor, m.count)
                return
        if kept < m.count:
            self._diagnostics.drop_late("odometry", m.count - kept)

    def changed(self, increment: Increment, constants: Array) -> tuple[Array, Array]:
        """Return the SE(2) logarithm (3,) of the motion of ``increment``, corrected with the estimated ``constants``
        (P,), and its Jacobian (3, P) by the constants."""
        delta, jacobian = kernels.changed(se2.log(increment.delta), increment.moving, constants, self._indices)
        return delta, jacobian

    def recalibrated(self, increment: Increment, constants: Array) -> Increment:
        """Return a copy of ``increment`` with its motion corrected by the estimated ``constants`` (P,)."""
        if not self.constants.names:
            return increment
        delta = kernels.recalibrated(increment.delta, increment.moving, constants, self._indices)
        return Increment(delta, increment.covariance, increment.duration, increment.still)

    def poses_at(self, start: ChainState, t: Array, constants: Array) -> Array:
        """Return the robot's poses (R, 3) at times ``t`` (R,) [s] by odometry, in the robot frame at the odometry state
        ``start``. The motion is corrected with the estimated ``constants`` (P,), to first order."""
        states = self.states(t)
        deltas = se2.between(np.array((start.x, start.y, start.heading)), states[:, 1:4])
        if not self.constants.names:
            return deltas
        changes, moved, later = self.constants.full(constants, len(PARAMETERS)), se2.log(deltas), t - start.t
        distances, moving = np.sign(later) * np.hypot(moved[:, 0], moved[:, 1]), later - (states[:, 7] - start.still)
        moved[:, :2] *= 1.0 + changes[0]
        moved[:, 2] += changes[1] * moved[:, 2] - changes[2] * moving + changes[3] * distances
        return np.asarray(se2.exp(moved))

    def slip(self, increment: Increment) -> tuple[Array, float]:
        """Return the covariance (3, 3) to add to the motion ``increment`` if the wheels slip, and the negative
        log-probability that they slip."""
        return slip(self.model, increment, use_gyro=self._use_gyro)


def whole_motion(log: Log, sensors: Sequence[str]) -> Motion:
    """Return the integrated odometry of a whole log, without deletion of old rows. ``sensors``: names of the sensors to
    use, "odometry" or "imu" or both."""
    motion = Motion(log.rig, tuple(sensors), Diagnostics())
    motion.horizon = math.inf
    for m in log.measurements(sensors):
        if isinstance(m, VelocityOdometry | IncrementOdometry | YawRate):
            motion.add(m)
    return motion


def odometry_of(log: Log) -> VelocityStream | IncrementStream:
    """Return the odometry stream of ``log``. The log must have one."""
    stream = log.streams["odometry"]
    assert isinstance(stream, VelocityStream | IncrementStream)
    return stream


def overlap(log: Log) -> tuple[float, float]:
    """Return the first and the last time [s] of a log with both odometry and a reference trajectory. The first time is
    after the last one if the log has no such time."""
    assert log.reference is not None
    t = odometry_of(log).t + log.rig.time_offset("odometry")
    return max(float(t[0]), float(log.reference.t[0])), min(float(t[-1]), float(log.reference.t[-1]))


def integrated(log: Log, model: OdometryModel) -> OdometryChain:
    """Return the integrated odometry of a log as a chain of states, which can be interpolated at any time. ``model``:
    the odometry model with calibration constants and noise."""
    chain = OdometryChain(model, horizon=np.inf)
    stream = odometry_of(log)
    t = stream.t + log.rig.time_offset("odometry")
    if isinstance(stream, VelocityStream):
        chain.add_velocities(t, stream.v, stream.w)
    else:
        chain.add_increments(t, stream.dx, stream.dy, stream.dtheta, stream.unknown)
    return chain
