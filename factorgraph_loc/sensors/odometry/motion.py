"""The odometry of a run, as all estimators take it in."""

from __future__ import annotations

import numpy as np

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Odometry
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.odometry.measurement import IncrementOdometry, VelocityOdometry, YawRate
from factorgraph_loc.sensors.odometry.model import odometry_model
from factorgraph_loc.sensors.twist.measurement import Twist
from factors import se2
from factors.motion import ChainState, Increment
from factors.odometry.chain import OdometryChain
from factors.se2 import Array

HORIZON = 5.0  # s of odometry that are kept
TWIST_TIME = 0.1  # s over which the velocity is taken


class Motion:
    """Odometry rows in, relative motion between any two recent times out.

    A gyro replaces the rotation of the wheels where ``sensors`` name it (``imu``).
    ``self_calibration``: the uncertain constants of the odometry are estimated; else their error is part of the noise.
    """

    def __init__(
        self, rig: Rig, sensors: tuple[str, ...], diagnostics: Diagnostics, *, self_calibration: bool = False
    ) -> None:
        self._rig = rig
        self._constants_as_noise = not self_calibration
        self._use_gyro = "imu" in sensors
        self._use_wheels = "odometry" in sensors
        self.horizon = HORIZON
        self._chain = self._new_chain()
        self._diagnostics = diagnostics

    def keep(self, horizon: float) -> None:
        """Keep the odometry of the last ``horizon`` seconds, as far as it is there yet."""
        self.horizon = self._chain.horizon = horizon

    def _new_chain(self) -> OdometryChain:
        model = odometry_model(self._rig, use_gyro=self._use_gyro, constants_as_noise=self._constants_as_noise)
        return OdometryChain(model, use_gyro=self._use_gyro, horizon=self.horizon)

    def add(self, m: Odometry) -> None:
        """Take a row; one of a sensor that is not used is counted as ignored, one older than what is kept as late."""
        if isinstance(m, Twist):
            self._diagnostics.ignore("motion in space")
            return
        if isinstance(m, YawRate) and not self._use_gyro:
            self._diagnostics.ignore("yaw rate")
        elif not isinstance(m, YawRate) and not self._use_wheels:
            self._diagnostics.ignore("odometry")
        elif not self._add(m):
            self._diagnostics.drop_late("odometry")

    def _add(self, m: VelocityOdometry | IncrementOdometry | YawRate) -> bool:
        if isinstance(m, VelocityOdometry):
            return self._chain.add_velocity(m.t, m.v, m.w)
        if isinstance(m, IncrementOdometry):
            return self._chain.add_increment(m.t, m.dx, m.dy, m.dtheta)
        return self._chain.add_yaw_rate(m.t, m.w)

    def state(self, t: float) -> ChainState:
        return self._chain.state(t)

    def relative(self, start: ChainState, end: ChainState) -> Increment:
        return self._chain.relative(start, end)

    def places(self, start: ChainState, t: Array, changes: Array | None = None) -> Array:
        """Poses (N, 3) at times (N,), before or after, in the frame of the pose at ``start``; ``changes``: of the constants
        :data:`factors.odometry.model.PARAMETERS`, taken as :func:`factors.odometry.model.recalibrated` does."""
        states = self._chain.states(t)
        deltas = se2.between(np.array((start.x, start.y, start.heading)), states[:, 1:4])
        if changes is None:
            return deltas
        moved, later = se2.log(deltas), t - start.t
        ways, moving = np.sign(later) * np.hypot(moved[:, 0], moved[:, 1]), later - (states[:, 7] - start.still)
        moved[:, :2] *= 1.0 + changes[0]
        moved[:, 2] += changes[1] * moved[:, 2] - changes[2] * moving + changes[3] * ways
        return np.asarray(se2.exp(moved))

    def twist(self, t: float) -> Array:
        """The robot's velocity (3,) just before ``t``, in its own frame."""
        moved = self.relative(self.state(t - TWIST_TIME), self.state(t))
        return np.asarray(se2.log(moved.delta) / TWIST_TIME)
