"""How estimators take odometry in."""

import pytest

from factorgraph_loc.estimators.base import Diagnostics
from factorgraph_loc.estimators.motion import Motion
from factorgraph_loc.measurements import IncrementOdometry, VelocityOdometry, YawRate
from factorgraph_loc.rig import ImuSettings, Rig

RIG = Rig(imu=ImuSettings(bias=0.1))


def test_a_gyro_replaces_the_rotation_of_velocities():
    motion = Motion(RIG, ("odometry", "imu"), Diagnostics())
    motion.add(VelocityOdometry(0.0, 1.0, 5.0))
    motion.add(YawRate(0.0, 0.4))
    assert motion.state(1.0).heading == pytest.approx(0.3)


def test_a_gyro_beside_increments_is_ignored_and_counted():
    diagnostics = Diagnostics()
    motion = Motion(RIG, ("odometry", "imu"), diagnostics)
    for i in range(4):
        motion.add(IncrementOdometry(0.1 * i, 0.05, 0.0, 0.02))
        motion.add(YawRate(0.1 * i + 0.05, 9.0))
    assert motion.state(0.3).x == pytest.approx(0.15, abs=1e-3)
    assert motion.state(0.3).heading == pytest.approx(0.06)
    assert diagnostics.ignored == {"yaw rate": 4}


def test_a_sensor_that_is_not_used_is_ignored_and_counted():
    diagnostics = Diagnostics()
    motion = Motion(RIG, ("imu",), diagnostics)
    motion.add(VelocityOdometry(0.0, 1.0, 5.0))
    assert motion.state(1.0).x == 0.0
    assert diagnostics.ignored == {"odometry": 1}
