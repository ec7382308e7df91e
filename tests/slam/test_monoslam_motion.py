"""Motion of the monoSLAM filter: transitions against numerical ones, and what is measured against what is known."""

import numpy as np
import pytest

from factorgraph_loc.slam import monoslam_motion
from factorgraph_loc.slam.monoslam_motion import Origin, RobotState, exp

ROBOT = RobotState(
    np.array((1.0, -2.0, 0.3)), exp(np.array((0.2, -0.1, 0.7))), np.array((0.3, 0.1, -0.2)), np.array((0.5, -0.4, 0.6))
)
LEVEL = RobotState(
    np.array((1.0, -2.0, 0.0)), exp(np.array((0.0, 0.0, 0.7))), np.array((0.3, 0.1, 0.0)), np.array((0.0, 0.0, 0.6))
)
MOTION = np.array((0.1, 0.02, 0.05)), np.diag((1e-4, 2e-4, 3e-4)), np.zeros((3, 0))
DT = 0.1
NOTHING = np.zeros(3)


def numerical(f, at):
    step = 1e-6
    reference = f(at)
    columns = [
        (f(at.plus(step * e)).minus(reference) - f(at.plus(-step * e)).minus(reference)) / (2 * step)
        for e in np.eye(12)
    ]
    return np.stack(columns, axis=1)


def test_the_error_is_carried_as_the_state_moves():
    def step(robot):
        return monoslam_motion.measured(robot, *MOTION, DT)

    np.testing.assert_allclose(step(ROBOT).transition, numerical(lambda r: step(r).robot, ROBOT), atol=1e-6)


def test_the_floor_carries_the_error_of_a_level_robot_as_stated():
    def step(robot):
        return monoslam_motion.on_the_floor(monoslam_motion.measured(robot, *MOTION, DT), DT, 0.01, 0.01, 1.0)

    np.testing.assert_allclose(step(LEVEL).transition, numerical(lambda r: step(r).robot, LEVEL), atol=2e-6)


def test_constants_move_a_robot_as_stated():
    def moved(change):
        delta = MOTION[0][:2].tolist()
        by = np.array(((0.1, 0.0), (0.02, 0.0), (0.0, 0.05)))
        return np.array((*delta, 0.05)) + rotated(by @ change), np.eye(3), by

    def rotated(local):  # a perturbation at the end, in the frame of the start
        return np.array((*(exp(np.array((0.0, 0.0, 0.05))) @ np.array((*local[:2], 0.0)))[:2], local[2]))

    transition = monoslam_motion.measured(LEVEL, *moved(np.zeros(2)), DT).transition
    for i, unit in enumerate(1e-6 * np.eye(2)):
        ahead, back = (monoslam_motion.measured(LEVEL, *moved(s * unit), DT).robot for s in (1, -1))
        np.testing.assert_allclose(transition[:, 12 + i], ahead.minus(back) / 2e-6, atol=1e-6)


def test_odometry_replaces_the_noise_of_what_it_measures_and_the_floor_holds_the_rest():
    """After long at rest with perfect odometry, height and tilt have the floor's deviations, and nothing else is uncertain."""
    still = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 0))
    robot, covariance = LEVEL, np.zeros((12, 12))
    for _ in range(100):
        step = monoslam_motion.on_the_floor(monoslam_motion.measured(robot, *still, DT), DT, 0.02, 0.03, 1.0)
        robot, covariance = step.robot, step.transition @ covariance @ step.transition.T + step.noise
    np.testing.assert_allclose(np.diag(covariance)[:6], (0.03**2, 0.03**2, 0, 0, 0, 0.02**2), atol=1e-9)
    moved = monoslam_motion.measured(LEVEL, *MOTION, DT)
    np.testing.assert_allclose(np.diag(moved.noise)[:6], (0, 0, 3e-4, 1e-4, 2e-4, 0), atol=1e-12)


def test_the_start_spreads_over_later_poses_and_points():
    origin = Origin(LEVEL, np.diag((0.0, 0.0, 0.1, 0.2, 0.2, 0.0)) ** 2)
    later = RobotState(LEVEL.position + np.array((3.0, 4.0, 0.0)), exp(np.array((0.0, 0.0, -1.0))), NOTHING, NOTHING)
    # a heading error of 0.1 rad moves what is 5 m away by 0.5 m, across
    assert np.trace(origin.of_pose(later)[3:, 3:]) == pytest.approx(0.5**2 + 2 * 0.2**2)
    assert np.trace(origin.of_point(later.position)) == pytest.approx(0.5**2 + 2 * 0.2**2)
    across = np.array((-0.8, 0.6, 0.0))
    assert across @ origin.of_point(later.position) @ across == pytest.approx(0.5**2 + 0.2**2)
