"""SE(2) on arrays: the group's laws, and agreement with GTSAM's Pose2."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerical import derivative

from factors import se2

coordinate = st.floats(-50.0, 50.0)
angle = st.floats(-3.1, 3.1)
poses = st.tuples(coordinate, coordinate, angle).map(np.array)
twists = st.tuples(coordinate, coordinate, st.one_of(angle, st.floats(-1e-6, 1e-6))).map(np.array)


def as_array(pose: gtsam.Pose2) -> np.ndarray:
    return np.array((pose.x(), pose.y(), pose.theta()))


@given(poses, poses)
def test_compose_and_between_are_those_of_gtsam(a, b):
    first, second = gtsam.Pose2(*a), gtsam.Pose2(*b)
    np.testing.assert_allclose(se2.compose(a, b)[:2], as_array(first.compose(second))[:2], atol=1e-9)
    np.testing.assert_allclose(se2.between(a, b)[:2], as_array(first.between(second))[:2], atol=1e-9)
    np.testing.assert_allclose(se2.adjoint(a), first.AdjointMap(), atol=1e-12)


@given(poses)
def test_inverse_undoes(a):
    np.testing.assert_allclose(se2.compose(a, se2.inverse(a)), np.zeros(3), atol=1e-9)


@given(twists)
def test_log_undoes_exp(xi):
    np.testing.assert_allclose(se2.log(se2.exp(xi)), xi, atol=1e-6)


@given(twists)
def test_exp_is_that_of_gtsam(xi):
    # GTSAM's loses digits at small angles: 1e-6 of a length of up to 70 m
    np.testing.assert_allclose(se2.exp(xi)[:2], as_array(gtsam.Pose2.Expmap(xi))[:2], atol=1e-4)


@given(st.lists(st.tuples(poses, poses), min_size=1, max_size=5))
def test_arrays_give_what_single_poses_give(pairs):
    a, b = np.array([p for p, _ in pairs]), np.array([q for _, q in pairs])
    for function in (se2.compose, se2.between):
        np.testing.assert_allclose(function(a, b), [function(p, q) for p, q in pairs], atol=1e-9)
    for function in (se2.inverse, se2.exp, se2.log, se2.adjoint):
        np.testing.assert_allclose(function(a), [function(p) for p, _ in pairs], atol=1e-9)


@given(st.floats(-1e3, 1e3))
def test_wrap_stays_in_its_interval_and_keeps_the_direction(value):
    wrapped = float(se2.wrap(np.array(value)))
    assert -np.pi < wrapped <= np.pi
    assert np.cos(wrapped - value) > 1.0 - 1e-9
    assert se2.wrap_scalar(value) == wrapped


@given(st.tuples(st.floats(-5, 5), st.floats(-5, 5), angle).map(np.array))
def test_right_jacobian_is_the_numerical_one(xi):
    numerical = derivative(lambda d: se2.log(se2.between(se2.exp(xi), se2.exp(xi + d))), 3)
    np.testing.assert_allclose(se2.right_jacobian(xi), numerical, atol=1e-6)


@given(poses)
def test_covariance_to_the_world_and_back(pose):
    covariance = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 0.5]])
    there = se2.body_to_world(pose, covariance)
    np.testing.assert_allclose(se2.world_to_body(pose, there), covariance, atol=1e-12)
    np.testing.assert_allclose(np.linalg.eigvalsh(there), np.linalg.eigvalsh(covariance), atol=1e-12)


rng = np.random.default_rng(0)
# headings and turns on both sides of where other series are used, and at half a turn
TURNS = np.concatenate(([0.0, 1e-9, -1e-4, 0.499, 0.501, np.pi, -np.pi + 1e-9], rng.uniform(-np.pi, np.pi, 40)))
MANY = np.column_stack((rng.normal(size=(len(TURNS), 2)), rng.permutation(TURNS)))
WAYS = np.column_stack((rng.normal(size=(len(TURNS), 2)), TURNS))


def same_poses(one, other):
    np.testing.assert_allclose(one[:, :2], other[:, :2], atol=1e-11)
    np.testing.assert_allclose(se2.wrap(one[:, 2] - other[:, 2]), 0.0, atol=1e-11)


def test_all_moved():
    delta = np.array((0.3, -0.2, 2.9))
    moved = se2.all_moved(MANY, delta, WAYS)
    same_poses(moved, se2.compose(se2.compose(MANY, delta), se2.exp(WAYS)))
    assert np.all(np.abs(moved[:, 2]) <= np.pi)


@pytest.mark.parametrize("heading", [0.0, 3.0, -np.pi])
def test_twists_lead_back_to_the_poses(heading):
    pose = np.array((1.0, -2.0, heading))
    twists = se2.twists_to(pose, MANY)
    same_poses(se2.compose(pose, se2.exp(twists)), MANY)
    turned = np.abs(se2.wrap(MANY[:, 2] - heading)) < 3.1  # of half a turn either way is right
    np.testing.assert_allclose(twists[turned], se2.log(se2.between(pose, MANY))[turned], atol=1e-10)
    same_poses(np.array([se2.moved(pose, se2.twist_to(pose, other)) for other in MANY]), MANY)


def test_moments():
    weights = rng.random(len(MANY))
    weights /= weights.sum()
    near = MANY * (1.0, 1.0, 0.3) + (0.0, 0.0, 3.0)
    near[:, 2] = se2.wrap(near[:, 2])
    mean, covariance = se2.moments(near, weights)
    heading = np.arctan2(weights @ np.sin(near[:, 2]), weights @ np.cos(near[:, 2]))
    np.testing.assert_allclose(mean, (*(weights @ near[:, :2]), heading), atol=1e-12)
    error = near - mean
    error[:, 2] = se2.wrap(error[:, 2])
    np.testing.assert_allclose(covariance, np.einsum("n,ni,nj->ij", weights, error, error), atol=1e-12)


def test_single_poses():
    for pose, other, twist in zip(MANY, MANY[::-1], WAYS, strict=True):
        inverse = se2.inverse_right_jacobian(twist)
        np.testing.assert_allclose(inverse @ se2.right_jacobian(twist), np.eye(3), atol=1e-9)
        same_poses(se2.compose_one(pose, other)[None], se2.compose(pose, other)[None])
        same_poses(se2.between_one(pose, other)[None], se2.between(pose, other)[None])
