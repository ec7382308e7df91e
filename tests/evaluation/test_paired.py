"""Paired statistics, against closed forms and known coverage."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorgraph_loc.evaluation.statistics import mcnemar, median_difference, median_ratio, quantile

OUTCOMES = st.lists(st.tuples(st.booleans(), st.booleans()), max_size=40)


def test_mcnemar_is_the_binomial_of_the_cases_that_differ():
    a = [True] * 9 + [False] + [True] * 5 + [False] * 4
    b = [False] * 9 + [True] + [True] * 5 + [False] * 4
    found = mcnemar(a, b)
    assert (found.only_a, found.only_b) == (9, 1)
    assert found.p == pytest.approx(2 * (1 + 10) / 2**10)  # nine or more of ten, to either side
    assert mcnemar([True, False], [True, False]).p == 1.0
    assert mcnemar([], []).p == 1.0


@given(OUTCOMES)
def test_mcnemar_knows_no_order_of_the_two(pairs):
    a, b = ([pair[i] for pair in pairs] for i in (0, 1))
    one, other = mcnemar(a, b), mcnemar(b, a)
    assert one.p == pytest.approx(other.p)
    assert (one.only_a, one.only_b) == (other.only_b, other.only_a)


def test_medians_are_compared_case_by_case():
    b = np.array((1.0, 4.0, 9.0, 25.0, 36.0))
    halved, longer = median_ratio(0.5 * b, b), median_difference(b + 2.0, b)
    assert (halved.value, halved.low, halved.high) == pytest.approx((0.5, 0.5, 0.5))
    assert (longer.value, longer.low, longer.high) == pytest.approx((2.0, 2.0, 2.0))


def test_what_never_came_is_beyond_every_number():
    a = np.array((1.0, 2.0, 3.0, math.inf, math.inf))
    b = np.array((2.0, 4.0, 6.0, 8.0, 10.0))
    assert median_ratio(a, b).value == pytest.approx(0.5)
    assert median_ratio(a, b).high == math.inf
    assert median_difference(b, a).low == -math.inf
    assert median_ratio(b, np.full(5, math.inf)).value == 0.0
    never = median_ratio(np.full(5, math.inf), np.full(5, math.inf))
    assert math.isnan(never.value)
    assert (never.low, never.high) == (0.0, math.inf)
    assert quantile(a, 0.5) == 3.0
    assert quantile(a, 0.6) == 3.0
    assert quantile(a, 0.9) == math.inf


def test_intervals_hold_what_is_true():
    """Both medians are e, so the difference is 0: the 95 % interval of 60 cases holds it in about 95 % of 100 trials, a bit more,
    as medians of few cases jump. Fewer than 86 happen in one of 7,000 if that is the true share."""
    rng = np.random.default_rng(2)
    held = 0
    for _ in range(100):
        hard = rng.standard_normal(60)
        a, b = (np.exp(1.0 + 0.8 * hard + 0.5 * rng.standard_normal(60)) for _ in range(2))
        found = median_difference(a, b)
        held += found.low <= 0.0 <= found.high
    assert held >= 86


def test_pairs_that_go_together_narrow_the_interval():
    rng = np.random.default_rng(3)
    b = np.exp(rng.standard_normal(100))
    a = 0.7 * b * np.exp(0.05 * rng.standard_normal(100))
    paired, mixed = median_ratio(a, b), median_ratio(a, rng.permutation(b))
    assert paired.low < 0.7 < paired.high < 0.8
    assert paired.high - paired.low < 0.5 * (mixed.high - mixed.low)
