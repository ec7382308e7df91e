"""Poses between those of a row, held against the same with arrays of one pose."""

import numpy as np

from factors import se2
from factors.motion import Increment, poses_between, propagate


def spread(rng):
    root = 0.1 * rng.standard_normal((3, 3))
    return root @ root.T + 1e-4 * np.eye(3)


def test_what_the_odometry_misses_the_next_pose_by_is_spread_over_the_way():
    rng = np.random.default_rng(5)
    poses, covariances = rng.standard_normal((3, 3)), np.array([spread(rng) for _ in range(3)])
    steps, step_noises = 0.3 * rng.standard_normal((2, 3)), np.array([spread(rng) for _ in range(2)])
    before, durations, lasting = np.array([0, 1, 1, 2]), np.array([0.1, 0.0, 0.4, 0.2]), np.array([0.5, 0.8])
    elsewhere = np.zeros(2, dtype=bool)
    deltas, noises = 0.3 * rng.standard_normal((4, 3)), np.array([spread(rng) for _ in range(4)])
    way = steps, step_noises, lasting
    at, around = poses_between(before, deltas, noises, durations, *way, elsewhere, poses, covariances)
    for i, k in enumerate(before):
        expected = se2.compose(poses[k], deltas[i])
        wide = propagate(covariances[k], Increment(deltas[i], noises[i], durations[i]))
        if k < 2:
            share = durations[i] / lasting[k]
            missed = se2.log(se2.between(se2.compose(poses[k], steps[k]), poses[k + 1]))
            expected = se2.compose(expected, se2.exp(share * missed))
            wide = (1.0 - share) * covariances[k] + share * covariances[k + 1] + share * (1.0 - share) * step_noises[k]
        np.testing.assert_allclose(at[i], expected, atol=1e-12)
        np.testing.assert_allclose(around[i], wide, atol=1e-12)


def test_a_pose_that_the_robot_was_carried_to_tells_nothing_of_those_before():
    poses, covariances = np.array(((0.0, 0.0, 0.0), (50.0, 0.0, 1.0))), np.tile(0.01 * np.eye(3), (2, 1, 1))
    carried = poses[1:], np.full((1, 3, 3), 100.0), np.array((0.4,)), np.array((True,))
    moved = np.array(((0.1, 0.0, 0.0),)), 0.01 * np.eye(3)[None], np.array((0.2,))
    at, around = poses_between(np.array((0,)), *moved, *carried, poses, covariances)
    np.testing.assert_allclose(at[0], (0.1, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(np.diag(around[0]), (0.02, 0.02 + 1e-4, 0.02), atol=1e-12)
