"""Poses in a row with parameters that all have in common, against dense algebra."""

import numpy as np
import pytest

from factors import chain


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
