"""Compiled odometry against plain formulas."""

import math

import numpy as np
import pytest

from factors import se2
from factors.motion import ChainState
from factors.odometry import kernels as odometry_kernels
from factors.odometry.model import (
    MINIMUM_HEADING_VARIANCE,
    MINIMUM_POSITION_VARIANCE,
    Growth,
    OdometryModel,
    recalibrated,
    relative_motion,
)

MODEL = OdometryModel(
    along=Growth(0.1, 0.02, 0.01), lateral=Growth(0.03, 0.01, 0.02), heading=Growth(0.05, 0.1, 0.002), direction=0.1
)
START = ChainState(1.0, 0.3, -0.2, 2.9, 4.0, 5.0, 0.5)
END = ChainState(1.7, 0.1, 0.4, 3.6, 4.9, 5.8, 0.6)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.mark.parametrize(("start", "end"), [(START, END), (END, START), (START, START)])
def test_relative_motion(start, end):
    found = relative_motion(MODEL, start, end)
    delta = se2.between(np.array(start[1:4]), np.array(end[1:4]))
    way = abs(end.path - start.path), abs(end.turn - start.turn), abs(end.t - start.t)
    unknown = max(0.0, end.unknown - start.unknown)
    along, lateral = (g.variance(*way) + MODEL.unknown_distance**2 * unknown for g in (MODEL.along, MODEL.lateral))
    along += (
        unknown * (way[0] / max(way[2], 1e-6)) ** 2 / 12.0
    )  # a share of the way that is uniform over a width of one
    heading = MODEL.heading.variance(*way) + MODEL.unknown_rotation**2 * unknown
    travel = MODEL.direction - delta[2] / 2.0
    turn = np.array(((math.cos(travel), -math.sin(travel)), (math.sin(travel), math.cos(travel))))
    # the heading's walk displaces the end across the chord, as seen from the end
    x, y = -se2.inverse(delta)[:2]
    across = np.array((-y, x))
    expected = np.zeros((3, 3))
    expected[:2, :2] = turn @ np.diag((along, lateral)) @ turn.T + heading * np.outer(across, across) / 3.0
    expected[:2, 2] = expected[2, :2] = heading * across / 2.0
    expected[2, 2] = heading
    expected += np.diag((MINIMUM_POSITION_VARIANCE, MINIMUM_POSITION_VARIANCE, MINIMUM_HEADING_VARIANCE))
    np.testing.assert_allclose(found.delta, delta, atol=1e-12)
    np.testing.assert_allclose(found.covariance, expected, atol=1e-12)
    assert found.duration == pytest.approx(way[2])


def test_an_increment_alone_is_recalibrated_as_with_its_jacobian(rng):
    increment, changes = relative_motion(MODEL, START, END), 0.1 * rng.standard_normal(4)
    alone = odometry_kernels.recalibrated(increment.delta, increment.duration, changes, np.arange(4))
    np.testing.assert_allclose(alone, recalibrated(increment, changes)[0], atol=1e-12)
