"""The odometry of a whole log."""

import math
from collections.abc import Sequence

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.odometry.measurement import IncrementOdometry, VelocityOdometry, YawRate
from factorgraph_loc.sensors.odometry.motion import OdometryMotion


def whole_motion(log: Log, sensors: Sequence[str]) -> OdometryMotion:
    """The motion between any two times of a log, from the odometry and gyro among ``sensors``."""
    motion = OdometryMotion(log.rig, tuple(sensors), Diagnostics())
    motion.keep(math.inf)
    for m in log.measurements(sensors):
        if isinstance(m, VelocityOdometry | IncrementOdometry | YawRate):
            motion.add(m)
    return motion
