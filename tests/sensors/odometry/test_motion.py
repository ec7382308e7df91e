"""How estimators take odometry in."""

import numpy as np
import pytest

from factorgraph_loc import IncrementOdometry, Rig, VelocityOdometry, YawRate
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.sensors.odometry.settings import GrowthSettings, ImuSettings, OdometryNoise, OdometrySettings
from factors.motion import propagate

RIG = Rig(imu=ImuSettings(bias=0.1))


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


@pytest.mark.parametrize("sigma", [0.0, 1e-6, 5.0])
def test_a_covariance_can_be_inverted_however_far_the_robot_seems_to_go(sigma):
    """The heading's error moves the robot across, along it only the odometry's own noise does."""
    growth, across = GrowthSettings(per_distance=1e-6), GrowthSettings(per_distance=sigma, per_rotation=5.0)
    noise = OdometryNoise(along=growth, lateral=growth, heading=across)
    motion = Motion(Rig(odometry=OdometrySettings(noise=noise)), ("odometry",), Diagnostics())
    covariance, before = 1e-8 * np.eye(3), motion.state(0.0)
    for i in range(40):
        motion.add(IncrementOdometry(0.1 * i, 1000.0, 0.0, 90.0))
        now = motion.state(0.1 * i)
        increment = motion.relative(before, now)
        covariance, before = propagate(covariance, increment), now
        for found in (increment.covariance, covariance):
            np.linalg.cholesky(found)
            assert np.all(np.linalg.eigvalsh(np.linalg.inv(found)) > 0.0)


def test_motion_of_before_what_is_kept_is_refused():
    motion = Motion(RIG, ("odometry",), Diagnostics())
    for i in range(300):
        motion.add(VelocityOdometry(0.1 * i, 1.0, 0.0))
    moved = motion.relative(motion.state(29.0 - motion.horizon), motion.state(29.0))
    assert moved.delta[0] == pytest.approx(motion.horizon)
    with pytest.raises(ValueError, match=r"the motion at 10\.000 s was asked for, but only that from"):
        motion.state(10.0)
