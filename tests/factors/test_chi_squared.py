"""The chi-square distribution is that of scipy.stats."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from factors import chi_squared


@given(st.floats(1e-6, 1.0 - 1e-6), st.floats(0.5, 1e4))
def test_quantiles_and_tails_are_those_of_scipy(probability, dof):
    value = float(chi_squared.quantile(probability, dof))
    assert value == pytest.approx(chi2.ppf(probability, dof), rel=1e-6)
    assert float(chi_squared.survival(value, dof)) == pytest.approx(1.0 - probability, abs=1e-9)
