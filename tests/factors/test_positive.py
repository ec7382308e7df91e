"""Covariances that are singular as numbers go."""

import numpy as np
import pytest

from factors import positive

SIGMAS = np.array((1e9, 1e9, 1e-3))


def flat(share):
    """A covariance (3, 3) of :data:`SIGMAS`, that in one direction has this share of what it has in the others."""
    turn, _ = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))
    covariance = (turn * (1.0, 1.0, share)) @ turn.T
    return (covariance + covariance.T) / 2.0 * SIGMAS[:, None] * SIGMAS


@pytest.mark.parametrize("share", [1e-20, 0.0, -1e-17])
def test_a_covariance_that_rounding_made_singular_is_inverted_as_the_nearest_one(share):
    covariance = flat(share)
    assert np.allclose(positive.nearest(covariance), covariance, rtol=1e-9, atol=0.0)
    whitener = positive.whitener(np.stack((covariance, np.eye(3))))
    assert np.allclose(whitener[1].T @ whitener[1], np.eye(3))
    assert np.all(np.isfinite(whitener))
    assert np.linalg.eigvalsh(positive.nearest(covariance) / SIGMAS[:, None] / SIGMAS)[0] > 0.1 * positive.LEAST
    assert np.all(np.diag(positive.inverse(covariance)) > 0.0)
    assert positive.squared(SIGMAS, covariance) > 0.0


def test_other_covariances_are_taken_as_they_are():
    covariance = flat(0.1)
    assert np.array_equal(positive.whitener(covariance), np.linalg.inv(np.linalg.cholesky(covariance)))
    assert np.array_equal(positive.inverse(covariance), np.linalg.inv(covariance))


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0, -1.0])
def test_what_is_no_covariance_is_refused(bad):
    with pytest.raises(np.linalg.LinAlgError):
        positive.nearest(np.diag((1.0, bad)))


def test_roots_and_solutions_are_those_of_the_nearest_one_too():
    line, right = np.array((1.0, 2.0)), np.ones((2, 3))
    covariance = np.outer(line, line)
    near = positive.nearest(covariance)
    root = positive.root(covariance)
    assert np.allclose(root @ root.T, near, rtol=1e-6)
    assert np.allclose(positive.solve(covariance, near @ right), right, rtol=1e-2)
    sound, right = flat(0.5), np.ones((3, 2))
    assert np.array_equal(positive.root(sound), np.linalg.cholesky(sound))
    assert np.array_equal(positive.solve(sound, right), np.linalg.solve(sound, right))
