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


@pytest.mark.parametrize(("rig", "turned"), [(RIG, 0.06), (Rig(), 0.09)])
def test_a_gyro_replaces_the_rotation_of_increments(rig, turned):
    """Of a rig without settings of a gyro too: then its bias is 0."""
    diagnostics = Diagnostics()
    motion = Motion(rig, ("odometry", "imu"), diagnostics)
    for i in range(4):
        motion.add(YawRate(0.1 * i, 0.3))
        motion.add(IncrementOdometry(0.1 * i, 0.05, 0.0, 0.5))
    assert motion.state(0.3).path == pytest.approx(0.15, abs=1e-2)
    assert motion.state(0.3).heading == pytest.approx(turned)
    assert diagnostics.ignored == {}


def test_a_sensor_that_is_not_used_is_ignored_and_counted():
    diagnostics = Diagnostics()
    motion = Motion(RIG, ("imu",), diagnostics)
    motion.add(VelocityOdometry(0.0, 1.0, 5.0))
    assert motion.state(1.0).x == 0.0
    assert diagnostics.ignored == {"odometry": 1}
