"""Loops over small matrices do what numpy does."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from factors import chi_squared, gaussian, positive
from factors.least_squares import minima, minimum
from factors.rfid import factor


@pytest.mark.parametrize("size", [1, 2, 3, 7])
@pytest.mark.parametrize("width", [1, 4])
def test_products_and_solutions(size, width):
    rng = np.random.default_rng(size)
    matrix, right = rng.normal(size=(size, size)), rng.normal(size=(size, width))
    if size > 1:
        matrix[0, 0] = 0.0  # no pivot
    solution, log_determinant = gaussian.solved(matrix, right)
    np.testing.assert_allclose(solution, np.linalg.solve(matrix, right), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(log_determinant, np.linalg.slogdet(matrix)[1], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(gaussian.inverse(matrix), np.linalg.inv(matrix), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(gaussian.product(matrix, right), matrix @ right, atol=1e-12)
    np.testing.assert_allclose(gaussian.product_by_transpose(right, right), right @ right.T, atol=1e-12)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_what_has_no_inverse_is_an_error(value):
    with pytest.raises(np.linalg.LinAlgError):
        gaussian.inverse(np.array(((1.0, 2.0), (value, value))))


def test_telling_directions_are_counted_as_by_eigenvalues():
    rng = np.random.default_rng(1)
    for rank in (0, 1, 2, 3):
        for _ in range(20):
            rows = rng.normal(size=(rank, 3)) * 10.0 ** rng.uniform(-1.0, 3.0)
            assert factor._rank(rows.T @ rows) == rank


@pytest.mark.parametrize("size", [1, 3, 9])
def test_compiled_roots_and_inverses_are_those_of_lapack(size):
    parts = np.random.default_rng(size).standard_normal((size, size + 2))
    covariance = parts @ parts.T
    np.testing.assert_allclose(gaussian.cholesky(covariance)[0], np.linalg.cholesky(covariance), atol=1e-12)
    np.testing.assert_allclose(gaussian.invert_covariance(covariance), np.linalg.inv(covariance), rtol=1e-9)


@pytest.mark.parametrize("bad", [np.diag((1.0, -1.0)), np.ones((2, 2)), np.diag((1.0, np.nan)), np.diag((np.inf, 1.0))])
def test_what_is_no_covariance_has_no_compiled_inverse(bad):
    assert not gaussian.cholesky(bad)[1]
    with pytest.raises(np.linalg.LinAlgError):
        gaussian.invert_covariance(bad)


@pytest.mark.parametrize("rows", [1, 2, 4])
def test_a_state_is_smoothed_as_by_the_joint_gaussian_of_both_times(rows):
    rng = np.random.default_rng(rows)
    parts = rng.standard_normal((3, 4, 6))
    covariance, later, both = parts @ parts.transpose(0, 2, 1)
    transition, noise, change = rng.standard_normal((rows, 4)), both[:rows, :rows], rng.standard_normal(4)
    full, added = np.eye(4), np.zeros((4, 4))
    full[:rows], added[:rows, :rows] = transition, noise
    predicted = full @ covariance @ full.T + added
    np.testing.assert_allclose(gaussian.predicted(covariance, transition, noise), predicted, rtol=1e-9)
    later = predicted / (1.0 + later[0, 0])
    gain = covariance @ full.T @ np.linalg.inv(predicted)
    for smoothed in (gaussian.smoothed, positive.smoothed):
        correction, after = smoothed(covariance, transition, noise, change, later)
        np.testing.assert_allclose(correction, gain @ change, rtol=1e-6)
        np.testing.assert_allclose(after, covariance + gain @ (later - predicted) @ gain.T, rtol=1e-6, atol=1e-9)


def test_what_rounding_makes_singular_is_smoothed_to_a_covariance():
    line = np.array((1e6, 2e6, 1e-3))
    flat = np.outer(line, line) + 1e-12 * np.eye(3)
    correction, after = positive.smoothed(flat, np.eye(3), np.zeros((3, 3)), np.zeros(3), 0.5 * flat)
    assert np.all(np.isfinite(correction))
    assert np.all(np.diag(after) > 0.0)


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


@given(st.floats(1e-6, 1.0 - 1e-6), st.floats(0.5, 1e4))
def test_quantiles_and_tails_are_those_of_scipy(probability, dof):
    value = float(chi_squared.quantile(probability, dof))
    assert value == pytest.approx(chi2.ppf(probability, dof), rel=1e-6)
    assert float(chi_squared.survival(value, dof)) == pytest.approx(1.0 - probability, abs=1e-9)


TRUTH = np.array(((2.0, -1.0), (0.5, 3.0), (-4.0, 0.1)))
SCALES = np.array((1e-3, 1e4))


def valley(truth, states):
    """Half the squares of (x - a) / s and of y - b + (x - a)^2 / s^2, in units of very different size."""
    x, y = ((states - truth) / SCALES).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    residual = np.stack((x, y + x**2), axis=1)
    jacobian = np.stack((np.stack((one, zero), axis=1), np.stack((2.0 * x, one), axis=1)), axis=1) / SCALES
    gradient = np.einsum("nij,ni->nj", jacobian, residual)
    return 0.5 * np.sum(residual**2, axis=1), gradient, np.einsum("nij,nik->njk", jacobian, jacobian)


def test_problems_of_different_scales_are_solved_together():
    calls = []

    def at(states, which):
        calls.append(len(which))
        return valley(TRUTH[which], states)

    start = TRUTH + SCALES * np.array(((3.0, -2.0), (0.0, 0.0), (-30.0, 5.0)))
    found = minima(at, start, 100, 1e-9 * SCALES)
    np.testing.assert_allclose((found.states - TRUTH) / SCALES, 0.0, atol=1e-8)
    np.testing.assert_allclose(found.curvatures[0] * np.outer(SCALES, SCALES), np.eye(2), atol=1e-6)
    assert calls[:2] == [3, 3]
    assert calls[2] == 2  # the second began at its minimum, where the cost is zero
    assert len(calls) < 40


def test_a_step_is_no_longer_than_allowed():
    reached = []

    def at(state):
        reached.append(state[0])
        return float(0.5 * (state[0] - 10.0) ** 2), state - 10.0, np.eye(1)

    state, cost, _ = minimum(at, np.zeros(1), 50, 1e-6, largest=1.0)
    assert np.max(np.diff(reached)) <= 1.0 + 1e-12
    np.testing.assert_allclose((state[0], cost), (10.0, 0.0), atol=1e-5)


def test_a_minimum_beyond_the_bounds_is_at_the_bound():
    def at(state):
        return float(0.5 * np.sum((state - 3.0) ** 2)), state - 3.0, np.eye(2)

    state, cost, _ = minimum(at, np.zeros(2), 50, 1e-9, high=np.array((1.0, 9.0)))
    np.testing.assert_allclose(state, (1.0, 3.0), atol=1e-6)
    np.testing.assert_allclose(cost, 2.0, atol=1e-6)


def test_what_a_problem_does_not_determine_stays():
    def at(state):
        return float(0.5 * state[0] ** 2), np.array((state[0], 0.0)), np.diag((1.0, 0.0))

    state, _, _ = minimum(at, np.array((1.0, 7.0)), 50, 1e-9)
    np.testing.assert_allclose(state, (0.0, 7.0), atol=1e-6)
