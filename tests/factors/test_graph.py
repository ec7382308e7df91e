"""Factors of a graph that belong to no sensor."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numerical import by_each

from factors import chain, se2
from factors.graph import PriorFactor, VectorPriorFactor, compressed, gaussian_factor
from factors.loops.factor import LoopFactor
from factors.motion import Increment, poses_between, propagate
from factors.se2 import Array

MEAN, SIGMAS = np.array((0.5, -2.0, 0.1)), np.array((0.1, 0.5, 2.0))


@pytest.mark.parametrize("value", [MEAN, np.array((0.7, -2.0, 5.0)), np.zeros(3)])
def test_a_prior_on_a_vector_is_gtsams(value):
    factor = VectorPriorFactor(MEAN, SIGMAS)
    twin = gtsam.PriorFactorVector(7, MEAN, gtsam.noiseModel.Diagonal.Sigmas(SIGMAS))
    values = gtsam.Values()
    values.insert(7, value)
    ours, theirs = gaussian_factor((7,), *factor.linearize([value])), twin.linearize(values)
    np.testing.assert_allclose(ours.jacobian()[0], theirs.jacobian()[0], atol=1e-12)
    np.testing.assert_allclose(ours.jacobian()[1], theirs.jacobian()[1], atol=1e-12)
    assert factor.cost([value]) == pytest.approx(twin.error(values))


def test_a_prior_on_a_pose_is_gtsams():
    mean, covariance = np.array((1.0, -2.0, 3.0)), np.diag((0.1, 0.2, 0.05)) ** 2 + 1e-3
    pose = se2.compose(mean, se2.exp(np.array((0.3, -0.2, 0.4))))
    factor = PriorFactor(mean, covariance)
    twin = gtsam.PriorFactorPose2(7, gtsam.Pose2(*mean), gtsam.noiseModel.Gaussian.Covariance(covariance))
    values = gtsam.Values()
    values.insert(7, gtsam.Pose2(*pose))
    # the root of the information by which GTSAM whitens is another, so that only costs compare
    assert factor.cost([pose]) == pytest.approx(twin.error(values), rel=1e-9)


def test_costs_are_half_the_squared_residuals_and_jacobians_the_numerical_ones():
    pose = np.array((1.0, -2.0, 3.0))
    for factor, value, poses in (
        (VectorPriorFactor(MEAN, SIGMAS), np.array((0.7, -1.0, 5.0)), ()),
        (PriorFactor(pose, np.diag((0.1, 0.2, 0.05)) ** 2), np.array((1.2, -2.1, -3.1)), (0,)),
    ):
        residual, (jacobian,) = factor.linearize([value])
        assert factor.cost([value]) == pytest.approx(0.5 * residual @ residual)
        (numerical,) = by_each(lambda v, factor=factor: factor.linearize(v)[0], [value], poses)
        np.testing.assert_allclose(jacobian, numerical, atol=1e-5)


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


def increment(rng):
    return Increment(0.3 * rng.normal(size=3), np.diag((1e-3, 2e-3, 1e-4)), 1.0)


def factors(rng):
    return [
        LoopFactor(None, np.array((0.5,)), increment(rng), increment(rng)),
        LoopFactor(np.array((0.3, -0.2, 0.5)), np.array((0.1, 0.1, 0.05)), increment(rng), increment(rng)),
        LoopFactor(np.array((0.3, -0.2, 0.5)), np.array((0.1, 0.1, 0.05))),
    ]


@pytest.mark.parametrize("which", range(3))
def test_jacobians_are_those_of_finite_differences(which):
    rng = np.random.default_rng(1)
    factor, values = factors(rng)[which], [rng.normal(size=3), rng.normal(size=3)]
    _, *blocks = factor.whitened(values)
    numerical = by_each(lambda v: factor.whitened(v)[0], values, (0, 1))
    for block, expected in zip(blocks, numerical, strict=True):
        np.testing.assert_allclose(block, expected, atol=1e-6)


def test_the_residual_of_one_place_is_the_distance_and_of_a_pose_its_error():
    here, there = np.array((1.0, 2.0, 0.7)), np.array((1.3, 2.4, -2.0))
    place = LoopFactor(None, np.array((0.5,)))
    assert np.linalg.norm(place.whitened([here, there])[0]) == pytest.approx(1.0)
    measured = se2.compose(se2.between(there, here), se2.exp(np.array((0.2, 0.0, 0.0))))
    pose = LoopFactor(measured, np.array((0.1, 0.1, 0.05)))
    np.testing.assert_allclose(pose.whitened([here, there])[0], (-2.0, 0.0, 0.0), atol=1e-12)


def test_what_the_odometry_adds_widens_the_noise():
    moved = Increment(np.zeros(3), np.diag((0.3, 0.3, 0.0)), 1.0)
    values = [np.array((1.0, 0.0, 0.0)), np.zeros(3)]
    alone, carried = LoopFactor(None, np.array((0.1,))), LoopFactor(None, np.array((0.1,)), moved, moved)
    assert alone.whitened(values)[0][0] == pytest.approx(10.0)
    assert carried.whitened(values)[0][0] == pytest.approx(0.61**-0.5)


def test_far_loops_have_no_influence_until_the_loss_is_wide():
    factor, values = LoopFactor(None, np.array((0.1,))), [np.array((10.0, 0.0, 0.0)), np.zeros(3)]
    pull = [np.linalg.norm(f.linearize(values)[0]) for f in (factor, factor.widened(factor.convex_width(values)))]
    assert pull[0] < 0.1
    assert pull[1] > 10.0
    assert factor.cost(values) == pytest.approx(4.5, rel=0.01)


def case(seed: int, d: int, rank: int) -> tuple[Array, Array]:
    """A gradient in the range of an information of that rank."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(d, rank)) * 10.0 ** rng.uniform(-2, 2)
    information = root @ root.T
    return information @ rng.normal(size=d), information


@given(seed=st.integers(0, 10_000), d=st.integers(1, 7), missing=st.integers(0, 7), nll=st.floats(1e-3, 1e3))
@settings(max_examples=200, deadline=None)
def test_value_and_gradient_are_exact_whatever_the_rank(seed: int, d: int, missing: int, nll: float) -> None:
    gradient, information = case(seed, d, max(d - missing, 0))
    residual, jacobian = compressed(nll, gradient, information)
    assert residual.shape == (d + 1,)
    assert jacobian.shape == (d + 1, d)
    assert np.isfinite(residual).all()
    assert np.isfinite(jacobian).all()
    assert 0.5 * residual @ residual == pytest.approx(nll, rel=1e-5)
    assert np.allclose(jacobian.T @ residual, gradient, rtol=1e-5, atol=1e-8 + 1e-5 * np.abs(gradient).max())


@given(seed=st.integers(0, 10_000), d=st.integers(1, 7))
@settings(max_examples=100, deadline=None)
def test_curvature_is_the_information_where_the_likelihood_allows_it(seed: int, d: int) -> None:
    gradient, information = case(seed, d, d)
    lowest = float(0.5 * gradient @ np.linalg.solve(information, gradient))
    _, jacobian = compressed(1.01 * lowest + 1e-3, gradient, information)
    assert np.allclose(jacobian.T @ jacobian, information, rtol=1e-6, atol=1e-7 * np.trace(information) + 1e-8)
    assert not jacobian[d].any()


def test_curvature_is_raised_along_the_gradient_alone() -> None:
    information = np.diag([4.0, 1.0, 9.0])
    gradient = np.array([4.0, 0.0, 0.0])
    _, jacobian = compressed(0.5, gradient, information)
    # the parabola's lowest point, nll - 2 here, is lifted to zero
    assert np.allclose(jacobian.T @ jacobian, np.diag([16.0, 1.0, 9.0]), rtol=1e-6)


def test_without_curvature_it_is_the_root_of_the_cost() -> None:
    gradient = np.array([0.3, -0.4])
    residual, jacobian = compressed(2.0, gradient, np.zeros((2, 2)))
    assert 0.5 * residual @ residual == pytest.approx(2.0)
    assert np.allclose(jacobian.T @ jacobian, np.outer(gradient, gradient) / 4.0, atol=1e-8)


def test_nothing_known_pulls_nowhere() -> None:
    residual, jacobian = compressed(3.0, np.zeros(3), np.zeros((3, 3)))
    assert residual == pytest.approx([0.0, 0.0, 0.0, 6.0**0.5])
    assert np.abs(jacobian).max() < 1e-4
    residual, jacobian = compressed(0.0, np.zeros(3), np.zeros((3, 3)))
    assert not residual.any()
    assert np.isfinite(jacobian).all()


@pytest.fixture(params=[0, 3])
def rows(request):
    """Seven poses; each residual is of one of them, or of two neighbours, and of the parameters."""
    rng, shared, poses = np.random.default_rng(5), request.param, 7
    first = np.concatenate((np.repeat(np.arange(poses), 4), np.repeat(np.arange(poses - 1), 3)))
    jacobian = rng.standard_normal((len(first), 6 + shared))
    jacobian[: 4 * poses, 3:6] = 0.0
    return poses, first, jacobian, rng.standard_normal(len(first))


def dense(poses, first, jacobian):
    out = np.zeros((len(first), 3 * poses + jacobian.shape[1] - 6))
    for row, i, values in zip(out, first, jacobian, strict=True):
        row[3 * i : 3 * i + 6][: len(out[0, 3 * i : 3 * i + 6])] = values[:6][: len(row[3 * i : 3 * i + 6])]
        row[3 * poses :] = values[6:]
    return out


def test_a_step_is_that_of_dense_algebra(rows):
    poses, first, jacobian, residual = rows
    whole = dense(poses, first, jacobian)
    for damping in (0.0, 0.3):
        found, steps, shared = chain.solved(chain.normal(poses, first, jacobian, residual), damping)
        curvature = whole.T @ whole
        expected = -np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), whole.T @ residual)
        assert found
        np.testing.assert_allclose(np.concatenate((steps.ravel(), shared)), expected, rtol=1e-9, atol=1e-12)


def test_marginal_covariances_are_those_of_dense_algebra(rows):
    poses, first, jacobian, residual = rows
    whole = dense(poses, first, jacobian)
    found, of_poses, of_shared = chain.covariances(chain.normal(poses, first, jacobian, residual))
    expected = np.linalg.inv(whole.T @ whole)
    assert found
    for i in range(poses):
        at = slice(3 * i, 3 * i + 3)
        np.testing.assert_allclose(of_poses[i], expected[at, at], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(of_shared, expected[3 * poses :, 3 * poses :], rtol=1e-8, atol=1e-12)


def test_what_is_not_determined_is_said(rows):
    poses, first, jacobian, residual = rows
    jacobian[(first == 3) | (first == 2), :] = 0.0
    system = chain.normal(poses, first, jacobian, residual)
    assert not chain.solved(system, 0.0)[0]
    assert not chain.covariances(system)[0]
