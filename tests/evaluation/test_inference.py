"""Tests, effect sizes and corrections against their definitions, and the share of false alarms where there is nothing."""

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter
from scipy.stats import wilcoxon

from factorgraph_loc.evaluation.inference import (
    contrast,
    differences,
    holm,
    independent_count,
    least_p,
    mean_nees_band,
    pooled,
    rank_biserial,
    signed_rank,
)
from factorgraph_loc.evaluation.statistics import mcnemar, median_difference, median_ratio, pooled_rms, quantile
from factorgraph_loc.evaluation.tables import ALL, comparison_cells


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
    """Three unequal logs, one without headings: 95 % of 2000 means lie within; fewer than 1850 or more than 1950 in one of 10^4."""
    rng = np.random.default_rng(3)
    counts, dofs = (20, 60, 400), (3, 2, 3)
    low, high = mean_nees_band(counts, dofs)
    means = np.mean([rng.chisquare(dof, (2000, n)).mean(axis=1) for n, dof in zip(counts, dofs, strict=True)], axis=0)
    assert 1850 <= np.sum((low <= means) & (means <= high)) <= 1950


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


METRIC = "causal.position_rmse"


def rows_of(values):
    """``values``: (log, estimator, seed) to the score, None for a failed run."""
    return [
        {
            "log": log,
            "estimator": estimator,
            "seed": seed,
            "status": "failed" if value is None else "ok",
            METRIC: value,
            "time_to_localized": None if value is None else 0.0,
            "timing.real_time_factor": None if value is None else 100.0,
        }
        for (log, estimator, seed), value in values.items()
    ]


def found(rows, log):
    (one,) = [d for d in differences(rows) if d["metric"] == METRIC and d["log"] == log]
    return one


def test_pooled_is_the_root_of_the_mean_square():
    assert pooled_rms([3.0, 4.0]) == pytest.approx(np.sqrt(12.5))


def test_one_seed_is_paired_with_each_of_the_other():
    values = {("one", "a", 0): 0.3} | {("one", "b", k): 0.1 * (k + 1) for k in range(1, 4)}
    d = found(rows_of(values), "one")
    assert d["pairs"] == 3
    assert d["value_b"] == pytest.approx(pooled_rms([0.2, 0.3, 0.4]))


def test_interval_covers_the_true_difference():
    """Estimators that are equally good: the 95 % interval holds 0 in about 95 % of 100 trials; 12 logs make it a bit narrow.

    If 90 % is the true share, fewer than 75 happen in one of 10^5.
    """
    rng = np.random.default_rng(5)
    held = 0
    for _ in range(100):
        values = {
            (f"log{i}", e, 0): float(v) for i in range(12) for e, v in zip("ab", rng.uniform(0.5, 1.0, 2), strict=True)
        }
        d = found(rows_of(values), "(all)")
        held += d["low"] <= 0.0 <= d["high"]
    assert held >= 75


def test_table_pools_seeds_and_logs():
    values = {("one", "a", 0): 0.3, ("one", "a", 1): 0.4, ("two", "a", 0): 0.1, ("two", "a", 1): None}
    header, lines = comparison_cells(rows_of(values))
    position, runs = header.index("causal pos [m]"), header.index("runs")
    one, two, pooled = lines
    assert one[position] == "0.354 ±0.071"
    assert (two[position], two[runs]) == ("0.100", "1/2")
    assert pooled[0] == ALL
    assert pooled[position] == f"{pooled_rms([pooled_rms([0.3, 0.4]), 0.1]):.3f}"
    assert pooled[runs] == "3/4"
