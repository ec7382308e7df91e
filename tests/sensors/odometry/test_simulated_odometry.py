"""Odometry made from a reference: exact to the model, and of its size."""

import math

import numpy as np
import pytest

from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.odometry.simulation import wheel_odometry


def winding(seconds=20.0):
    """At 0.5 m/s along a wave, in poses 5 ms apart."""
    t = np.arange(0.0, seconds + 1e-9, 0.005)
    return Trajectory(t, np.stack((0.5 * t, np.sin(0.5 * t), np.arctan2(0.5 * np.cos(0.5 * t), 0.5)), axis=1))


def test_the_model_as_it_is_written():
    """The same by scalars: the order of the draws is part of the contract."""
    reference = winding(2.0)
    found = wheel_odometry(reference, 7)
    assert (found.t[0], found.dx[0], found.dy[0], found.dtheta[0]) == (0.0, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(found.t, np.arange(21) * 0.1)
    poses = reference.poses[::20]
    rng = np.random.default_rng(7)
    s, b, g = 0.02 * rng.standard_normal(), math.radians(1.0) * rng.standard_normal(), 0.02 * rng.standard_normal()
    along = [(rng.standard_normal(), rng.standard_normal()) for _ in range(20)]
    turned = [rng.standard_normal() for _ in range(20)]
    for i in range(20):
        x, y, yaw = poses[i]
        ex, ey = poses[i + 1, 0] - x, poses[i + 1, 1] - y
        dx, dy = ex * math.cos(yaw) + ey * math.sin(yaw), ey * math.cos(yaw) - ex * math.sin(yaw)
        ds = math.hypot(dx, dy)
        assert found.dx[i + 1] == pytest.approx((1 + s) * dx + 0.01 * math.sqrt(ds) * along[i][0])
        assert found.dy[i + 1] == pytest.approx((1 + s) * dy + 0.005 * math.sqrt(ds) * along[i][1])
        expected = (1 + g) * (poses[i + 1, 2] - yaw) + b * ds + math.radians(1.5) * math.sqrt(ds) * turned[i]
        assert found.dtheta[i + 1] == pytest.approx(expected)


def test_long_gaps_have_no_rows():
    """The rows before and behind them are on one grid, and lead from pose to pose as without a gap."""
    way = winding(2.0)
    later = 29 * 86_400.0
    reference = Trajectory(
        np.concatenate((way.t, way.t + 70.06, way.t + later)),
        np.concatenate([way.poses + np.array((x, 0.0, 0.0)) for x in (0, 5, 10)]),
    )
    odometry = wheel_odometry(reference, 3)
    behind = 70.1 + 0.1 * np.arange(20)
    np.testing.assert_allclose(odometry.t, np.concatenate((0.1 * np.arange(21), behind, later + 0.1 * np.arange(21))))
    assert odometry.dx[21] == pytest.approx(4.0, rel=0.2)  # 5 m to where the first part began, of which 1 m was driven
    short = Trajectory(np.concatenate((way.t, way.t + 61.0)), np.concatenate((way.poses, way.poses)))
    assert len(wheel_odometry(short, 3).t) == 631
