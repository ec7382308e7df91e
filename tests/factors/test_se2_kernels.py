"""The compiled operations on many poses against those of :mod:`factors.se2`."""

import numpy as np
import pytest

from factors import se2

rng = np.random.default_rng(0)
# headings and turns on both sides of where other series are used, and at half a turn
TURNS = np.concatenate(([0.0, 1e-9, -1e-4, 0.499, 0.501, np.pi, -np.pi + 1e-9], rng.uniform(-np.pi, np.pi, 40)))
POSES = np.column_stack((rng.normal(size=(len(TURNS), 2)), rng.permutation(TURNS)))
TWISTS = np.column_stack((rng.normal(size=(len(TURNS), 2)), TURNS))


def same_poses(one, other):
    np.testing.assert_allclose(one[:, :2], other[:, :2], atol=1e-11)
    np.testing.assert_allclose(se2.wrap(one[:, 2] - other[:, 2]), 0.0, atol=1e-11)


def test_all_moved():
    delta = np.array((0.3, -0.2, 2.9))
    moved = se2.all_moved(POSES, delta, TWISTS)
    same_poses(moved, se2.compose(se2.compose(POSES, delta), se2.exp(TWISTS)))
    assert np.all(np.abs(moved[:, 2]) <= np.pi)


@pytest.mark.parametrize("heading", [0.0, 3.0, -np.pi])
def test_twists_lead_back_to_the_poses(heading):
    pose = np.array((1.0, -2.0, heading))
    twists = se2.twists_to(pose, POSES)
    same_poses(se2.compose(pose, se2.exp(twists)), POSES)
    turned = np.abs(se2.wrap(POSES[:, 2] - heading)) < 3.1  # of half a turn either way is right
    np.testing.assert_allclose(twists[turned], se2.log(se2.between(pose, POSES))[turned], atol=1e-10)
    same_poses(np.array([se2.moved(pose, se2.twist_to(pose, other)) for other in POSES]), POSES)


def test_moments():
    weights = rng.random(len(POSES))
    weights /= weights.sum()
    near = POSES * (1.0, 1.0, 0.3) + (0.0, 0.0, 3.0)
    near[:, 2] = se2.wrap(near[:, 2])
    mean, covariance = se2.moments(near, weights)
    heading = np.arctan2(weights @ np.sin(near[:, 2]), weights @ np.cos(near[:, 2]))
    np.testing.assert_allclose(mean, (*(weights @ near[:, :2]), heading), atol=1e-12)
    error = near - mean
    error[:, 2] = se2.wrap(error[:, 2])
    np.testing.assert_allclose(covariance, np.einsum("n,ni,nj->ij", weights, error, error), atol=1e-12)


def test_single_poses():
    for pose, other, twist in zip(POSES, POSES[::-1], TWISTS, strict=True):
        np.testing.assert_allclose(se2.adjoint_one(pose), se2.adjoint(pose), atol=1e-12)
        np.testing.assert_allclose(se2.right_jacobian_one(twist), se2.right_jacobian(twist), atol=1e-12)
        inverse = se2.inverse_right_jacobian(twist)
        np.testing.assert_allclose(inverse @ se2.right_jacobian(twist), np.eye(3), atol=1e-9)
        same_poses(se2.compose_one(pose, other)[None], se2.compose(pose, other)[None])
        same_poses(se2.between_one(pose, other)[None], se2.between(pose, other)[None])
