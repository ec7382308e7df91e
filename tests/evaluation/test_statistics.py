"""Paired differences and the table of a comparison."""

import numpy as np
import pytest

from factorgraph_loc.evaluation.inference import differences
from factorgraph_loc.evaluation.statistics import pooled_rms
from factorgraph_loc.evaluation.tables import ALL, comparison_cells

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
