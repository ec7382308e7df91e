"""Motion in space as factors: derivatives against numerical ones, and what is known of velocities against sampled ones."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.optimize import approx_fprime

from factorgraph_loc.slam.space_motion import POSES, ROBOT, VELOCITIES, RobotState, exp
from factorgraph_loc.slam.space_motion_models import ConstantVelocity, KnownState, pose_of, robot_of, velocities

TIMES = (2.0, 2.1, 2.35)


def poses(count, rng):
    """Poses that follow each other as those of a camera in a hand."""
    found = [gtsam.Pose3(gtsam.Rot3(exp(np.array((0.3, -0.5, 1.0)))), np.array((1.0, 2.0, 0.5)))]
    for _ in range(count - 1):
        found.append(found[-1].retract(0.2 * rng.standard_normal(6)))
    return found


def start(pose, rng):
    """What is known of a moving robot at a pose, with correlations."""
    root = 0.1 * rng.standard_normal((ROBOT, ROBOT))
    still = robot_of(pose)
    robot = RobotState(still.position, still.rotation, np.array((0.1, 0.2, 0.3)), np.array((-0.2, 0.1, 0.4)))
    return KnownState(TIMES[0], robot, root @ root.T)


def test_velocities_are_those_of_the_step():
    """A step at a velocity and turn rate gives these back."""
    rng = np.random.default_rng(5)
    known = start(poses(1, rng)[0], rng)
    there = ConstantVelocity(1.0, 1.0).step(replace(known, t=0.0), 0.4).robot
    found = velocities(pose_of(known.robot), pose_of(there), 0.4)[0]
    np.testing.assert_allclose(found, np.concatenate((known.robot.velocity, known.robot.rate)), atol=1e-9)


def test_derivatives_of_velocities():
    first, second = poses(2, np.random.default_rng(5))
    _, by_first, by_second = velocities(first, second, 0.1)
    by_both = approx_fprime(
        np.zeros(12), lambda d: velocities(first.retract(d[:6]), second.retract(d[6:]), 0.1)[0], 1e-7
    )
    np.testing.assert_allclose(np.hstack((by_first, by_second)), by_both, atol=1e-4)


@pytest.mark.parametrize("count", [2, 3])
def test_derivatives_of_the_factor(count):
    rng, values = np.random.default_rng(5), gtsam.Values()
    at = poses(count, rng)
    known = start(at[0], rng)  # where the first pose is: its error enters to first order
    for key, pose in enumerate(at):
        values.insert(key, pose)
    (factor,) = ConstantVelocity(0.7, 0.9).factors(range(count), TIMES[:count], known)
    jacobian, _ = factor.linearize(values).jacobian()

    def error(d):
        moved = gtsam.Values()
        for key, pose in enumerate(at):
            moved.insert(key, pose.retract(d[6 * key : 6 * key + 6]))
        return factor.whitenedError(moved)

    np.testing.assert_allclose(jacobian, approx_fprime(np.zeros(6 * count), error, 1e-7), atol=1e-2)


@pytest.mark.parametrize("count", [1, 2])
def test_what_is_known_of_pose_and_velocity(count):
    """Mean and covariance are those of drawn poses, with velocities that are drawn given the first pose where no other is there.

    Of 20,000: a standard deviation is within 3 % of the right one but for one in 1e5.
    """
    rng = np.random.default_rng(5)
    at = poses(count, rng)
    known, root = start(at[0], rng), 0.01 * rng.standard_normal((6 * count, 6 * count))
    values = gtsam.Values()
    for key, pose in enumerate(at):
        values.insert(key, pose)
    found = ConstantVelocity(0.7, 0.9).state(values, range(count), root @ root.T, TIMES[:count], known)
    drawn, gain, rest = [], *known.by_pose()
    still = np.linalg.cholesky(rest)
    for d in (root @ rng.standard_normal((6 * count, 20000))).T:
        moved = [pose.retract(d[6 * i : 6 * i + 6]) for i, pose in enumerate(at)]
        if count > 1:
            there = velocities(*moved, TIMES[1] - TIMES[0])[0]
        else:
            error = robot_of(moved[0]).minus(known.robot)[POSES]
            there = np.concatenate((known.robot.velocity, known.robot.rate))
            there += gain @ error + still @ rng.standard_normal(6)
        drawn.append(np.concatenate((robot_of(moved[-1]).minus(found.robot)[POSES], there)))
    sample = np.array(drawn)
    sigmas = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(sample.std(axis=0), sigmas, rtol=0.03)
    mean = np.concatenate((np.zeros(6), found.robot.velocity, found.robot.rate))
    np.testing.assert_array_less(np.abs(sample.mean(axis=0) - mean) / sigmas, 0.05)
    correlation = np.corrcoef(sample.T)[POSES, VELOCITIES]
    np.testing.assert_allclose(correlation, (found.covariance / np.outer(sigmas, sigmas))[POSES, VELOCITIES], atol=0.04)
