"""Loops over small matrices do what numpy does."""

import numpy as np
import pytest

from factors import gaussian, positive
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
