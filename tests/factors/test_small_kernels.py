"""Loops over small matrices do what numpy does."""

import numpy as np
import pytest

from factors import gaussian
from factors.rfid import update


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
            assert update._telling(rows.T @ rows) == rank
