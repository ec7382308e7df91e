"""Compressed costs: value, gradient and curvature are those of the likelihood."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factors.graph import compressed
from factors.se2 import Array


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
