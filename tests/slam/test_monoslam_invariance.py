"""The covariance of monoSLAM without a map: directions that no image tells stay as they were, whatever the estimate did."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.slam.monoslam_invariance import carried
from factorgraph_loc.slam.monoslam_motion import ROBOT, RobotState, exp
from factorgraph_loc.slam.monoslam_state import MapPoint, SlamState
from factors.camera import inverse_depth

CONSTANTS = 2
STEP = 1e-6


def state(rng, constants):
    """A robot with two points and two rays; ``constants`` (P,), of which the second scales distances."""
    ray = (1.0, 0.5, 0.2, 0.4, -0.3, 0.6)
    values = np.concatenate(((3.0, 1.0, 0.5), ray, (-2.0, 4.0, 1.5), ray[::-1])) + 0.1 * rng.standard_normal(18)
    points = tuple(MapPoint(str(i), ray, None, 0.0) for i, ray in enumerate((False, True, False, True)))
    robot = RobotState(rng.standard_normal(3), exp(rng.standard_normal(3)), *rng.standard_normal((2, 3)))
    return SlamState(robot, constants, np.zeros((ROBOT + len(constants) + 18,) * 2), points, values)


def moved(s, turn, shift, growth):
    """The same state in a world that is turned, shifted and enlarged."""
    rotation, scale = exp(turn), 1.0 + growth
    robot = RobotState(
        scale * rotation @ s.robot.position + shift,
        rotation @ s.robot.rotation,
        scale * rotation @ s.robot.velocity,
        s.robot.rate,
    )
    values = s.values.copy()
    for point, start in zip(s.points, s.starts().tolist(), strict=True):
        values[start : start + 3] = scale * rotation @ values[start : start + 3] + shift
        if point.ray:
            (ahead,), _ = inverse_depth.directions(s.values[None, start : start + 6])
            x, y, z = rotation @ ahead
            values[start + 3 : start + 6] = np.arctan2(y, x), np.arcsin(z), s.values[start + 5] / scale
    constants = s.constants.copy()
    if len(constants):
        constants[1] = scale * (1.0 + constants[1]) - 1.0
    return replace(s, robot=robot, values=values, constants=constants)


def direction(s, change):
    """The error (12 + P + D,) of a small ``change`` (7,) of the world, per unit."""
    ahead = moved(s, STEP * change[:3], STEP * change[3:6], STEP * change[6])
    back = moved(s, -STEP * change[:3], -STEP * change[3:6], -STEP * change[6])
    return np.concatenate(
        (ahead.robot.minus(back.robot), ahead.constants - back.constants, ahead.values - back.values)
    ) / (2 * STEP)


@pytest.mark.parametrize("scaled", [True, False])
def test_a_common_change_of_the_world_stays_one_when_the_estimate_moves(scaled):
    rng = np.random.default_rng(3)
    before = state(rng, np.array((0.05, 0.1)) if scaled else np.zeros(0))
    after = before.plus(0.2 * rng.standard_normal(len(before.covariance)), before.covariance)
    for change in rng.standard_normal((5, 7)):
        if not scaled:
            change[6] = 0.0
        was, now = direction(before, change), direction(after, change)
        found = carried(before, replace(after, covariance=np.outer(was, was)), 1 if scaled else None)
        np.testing.assert_allclose(found, np.outer(now, now), rtol=1e-5, atol=1e-4)


def test_an_update_that_moves_nothing_changes_nothing():
    rng = np.random.default_rng(4)
    before = state(rng, np.zeros(CONSTANTS))
    root = rng.standard_normal(before.covariance.shape)
    np.testing.assert_allclose(carried(before, replace(before, covariance=root @ root.T), 1), root @ root.T, atol=1e-9)
