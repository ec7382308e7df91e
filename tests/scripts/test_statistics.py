"""Statistics over runs, against distributions and figures that are known."""

import math

import numpy as np
import pytest
from benchmarking.statistics import first_held, rmse_ratio, share_in_band


def test_right_covariances_are_in_the_band_at_95_percent_of_the_times():
    """False alarm: 20,000 independent times have a share of 0.95 +- 0.0062 (four standard deviations), one in 16,000."""
    nees = np.random.default_rng(1).chisquare(3, (30, 20_000))
    assert share_in_band(nees) == pytest.approx(0.95, abs=0.0062)
    assert share_in_band(1.5 * nees) < 0.6
    assert share_in_band(0.6 * nees) < 0.6
    assert share_in_band(np.random.default_rng(2).chisquare(2, (30, 20_000)), 2) == pytest.approx(0.95, abs=0.0062)


def test_runs_without_an_estimate_narrow_nothing():
    nees = np.random.default_rng(1).chisquare(3, (30, 20_000))
    nees[3:, ::2] = np.nan
    assert share_in_band(nees) == pytest.approx(0.95, abs=0.0062)
    nees[:] = np.nan
    nees[0, 0] = 3.0
    assert share_in_band(nees) == 1.0
    assert math.isnan(share_in_band(nees[:, 1:]))


def test_a_ratio_pools_squares_and_pairs_logs():
    b = np.array((1.0, 2.0, 10.0, 3.0))
    same = rmse_ratio(0.9 * b, b)
    assert (same.value, same.low, same.high, same.worst) == pytest.approx((0.9, 0.9, 0.9, 0.9))
    found = rmse_ratio(np.array((3.0, 4.0)), np.array((4.0, 3.0)))
    assert (found.value, found.worst) == pytest.approx((1.0, 4.0 / 3.0))
    assert (found.low, found.high) == pytest.approx((3.0 / 4.0, 4.0 / 3.0))


def test_held_is_what_stays_good_long_enough_to_tell():
    t = np.arange(101) * 0.1
    good = np.ones(101, dtype=bool)
    assert first_held(t, good, 3.0) == 0.0
    good[20] = False
    assert first_held(t, good, 3.0) == pytest.approx(2.1)
    assert first_held(t, good, 1.9) == 0.0
    good[72] = False
    assert first_held(t, good, 5.0) == pytest.approx(2.1)
    good[60] = False
    assert math.isnan(first_held(t, good, 5.0))
    assert math.isnan(first_held(t[:10], good[:10], 3.0))  # ends too soon
    assert math.isnan(first_held(np.empty(0), np.empty(0, dtype=bool), 1.0))
