"""Tests, effect sizes and corrections against their definitions, and the share of false alarms where there is nothing."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter
from scipy.stats import wilcoxon

from factorgraph_loc.evaluation.inference import (
    contrast,
    holm,
    independent_count,
    least_p,
    mean_nees_band,
    pooled,
    rank_biserial,
    signed_rank,
)
from factorgraph_loc.evaluation.statistics import pooled_rms


@pytest.mark.parametrize("count", [6, 17, 40, 200])
def test_signed_rank_is_that_of_scipy(count):
    differences = np.random.default_rng(count).normal(0.2, 1.0, count)
    method = "exact" if count <= 60 else "approx"
    expected = wilcoxon(differences, method=method, correction=True).pvalue
    assert signed_rank(differences) == pytest.approx(expected, rel=1e-9)


def test_signed_rank_with_ties_and_zeros_counts_all_signs():
    differences = np.array([0.0, 0.1, 0.1, -0.1, 0.3, 0.5, 0.5])
    ranks = np.array([1.0, 3.0, 3.0, 3.0, 5.0, 6.5, 6.5])
    positive = ranks[differences > 0].sum()
    used = ranks[1:]
    sums = np.array([np.dot(signs, used) for signs in product((0, 1), repeat=len(used))])
    extreme = np.abs(sums - used.sum() / 2) >= abs(positive - used.sum() / 2) - 1e-9
    assert signed_rank(differences) == pytest.approx(extreme.mean())


def test_all_on_one_side_is_the_least_p():
    assert signed_rank(np.arange(1.0, 7.0)) == pytest.approx(least_p(6)) == pytest.approx(2 / 64)
    assert signed_rank(np.zeros(8)) == 1.0


def test_effect_of_a_worked_example():
    """Ranks 1 to 4; against the difference stands rank 1 alone: (9 - 1) / 10."""
    assert rank_biserial(np.array([-1.0, 2.0, 3.0, 4.0])) == pytest.approx(0.8)


def test_holm_of_a_worked_example():
    assert holm([0.01, 0.04, None, 0.03]) == pytest.approx([0.03, 0.06, None, 0.06])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_holm_lies_between_none_and_bonferroni(p_values):
    corrected = holm(p_values)
    for p, c in zip(p_values, corrected, strict=True):
        assert p <= c <= min(1.0, len(p_values) * p) + 1e-12


def test_pooled_counts_each_log_once():
    scores = {"one": {0: 0.3, 1: 0.4, 2: None}, "two": {0: 0.1}}
    found = pooled(scores, rms=True)
    assert found.value == pytest.approx(pooled_rms([pooled_rms([0.3, 0.4]), 0.1]))
    assert (found.low, found.units, found.count) == (None, "logs", 2)
    assert (found.least, found.most) == pytest.approx((0.1, pooled_rms([0.3, 0.4])))
    assert pooled(scores, rms=False).value == pytest.approx((0.35 + 0.1) / 2)
    assert pooled({"one": {0: None}}, rms=True) is None


def test_one_log_tells_of_its_seeds():
    rng = np.random.default_rng(0)
    a, b = ({"one": dict(enumerate(rng.normal(mean, 0.1, 20)))} for mean in (1.0, 1.3))
    found = contrast(a, b, rms=True)
    assert (found.units, found.count) == ("seeds", 20)
    assert found.low < found.difference < found.high < 0.0
    assert found.p < 1e-4
    assert found.effect < -0.9


def test_few_logs_stand_side_by_side():
    a = {f"log{i}": {0: 1.0 + i} for i in range(5)}
    b = {f"log{i}": {0: 2.0 + i} for i in range(5)}
    found = contrast(a, b, rms=False)
    assert (found.low, found.p, found.effect) == (None, None, None)
    assert found.difference == pytest.approx(-1.0)
    assert found.by_log["log3"] == (4.0, 5.0)


def test_variations_of_a_log_count_as_one():
    """Six worlds at three speeds are no 18 logs."""
    rng = np.random.default_rng(4)
    worlds = [(f"world{i}, {speed} m/s", f"world{i}") for i in range(6) for speed in (1, 2, 3)]
    a, b = ({log: {0: float(v)} for (log, _), v in zip(worlds, rng.uniform(x, x + 1, 18), strict=True)} for x in (1, 2))
    apart, together = contrast(a, b, rms=False), contrast(a, b, rms=False, alike=dict(worlds))
    assert (apart.count, together.count) == (18, 6)
    assert together.p == pytest.approx(least_p(6))
    assert apart.p < together.p
    assert together.difference == pytest.approx(apart.difference)
    assert len(together.by_log) == 18
    figure = pooled(a, rms=False, alike=dict(worlds))
    assert (figure.count, figure.logs) == (6, 6)
    assert figure.low < figure.value < figure.high


def test_what_lacks_a_partner_is_counted():
    a = {"one": {0: 1.0, 1: None}, "two": {0: 1.0}, "three": {0: 1.0, 1: 1.0}}
    b = {"one": {0: 2.0, 1: 2.0}, "two": {0: 1.5}, "four": {0: 1.0}}
    found = contrast(a, b, rms=True)
    assert (found.pairs, found.left_out) == (2, 4)
    assert contrast({"one": {0: None}}, {"one": {0: 1.0}}, rms=True) is None


@pytest.mark.parametrize("memory", [0.0, 0.9, 0.98])
def test_independent_count_of_an_autoregression(memory):
    """Its correlation time is (1 + a) / (1 - a) steps. Mean of 20 series, right within a fifth; for 0.98 within a third."""
    rng = np.random.default_rng(1)
    n = 20000
    counts = [independent_count(lfilter([1.0], [1.0, -memory], rng.standard_normal(n))) for _ in range(20)]
    expected = n * (1.0 - memory) / (1.0 + memory)
    assert np.mean(counts) == pytest.approx(expected, rel=0.2 if memory < 0.95 else 0.33)


def test_band_holds_the_mean_of_consistent_logs():
    """Three logs of unequal length: 95 % of 2000 means lie within; fewer than 1850 or more than 1950 in one of 10^4."""
    rng = np.random.default_rng(3)
    counts, dof = (20, 60, 400), 3
    low, high = mean_nees_band(counts, dof)
    means = np.mean([rng.chisquare(dof, (2000, n)).mean(axis=1) / dof for n in counts], axis=0)
    assert 1850 <= np.sum((low <= means) & (means <= high)) <= 1950
