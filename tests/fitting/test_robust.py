"""Robust fits, and which constants are worth keeping, on a straight line."""

import numpy as np
import pytest

from factorgraph_loc.fitting.robust import Constant, fit, folds, gains, is_worth

SLOPE = Constant("slope", 0.0, 1.0, -10.0, 10.0)
OFFSET = Constant("offset", 0.0, 1.0, -10.0, 10.0)


def line(seed, slope, offset, outliers=0.0, count=400):
    """Residuals of a line through noisy points, in standard deviations, as a function of slope and offset; and blocks."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, count)
    y = slope * x + offset + 0.1 * rng.standard_normal(count)
    y[rng.random(count) < outliers] = 50.0
    return lambda values: ((values[0] * x + values[-1] * (len(values) > 1) - y) / 0.1)[:, None], np.arange(count)


def test_outliers_move_the_fit_by_little():
    """3 % of outliers, all on one side, move the offset by about 0.1 * 2 * 0.03; the mean would move by 1.5."""
    whitened, blocks = line(1, 2.0, 0.5, outliers=0.03)
    found = fit([SLOPE, OFFSET], np.zeros(2), whitened, blocks)
    np.testing.assert_allclose(found.values, (2.0, 0.5), atol=0.04)


def test_standard_errors_are_those_of_repetitions():
    """The ratio over 200 repetitions has a standard error of 5 %: 20 % are four."""
    runs = [fit([SLOPE, OFFSET], np.zeros(2), *line(seed, 2.0, 0.5, count=100)) for seed in range(200)]
    spread = np.std([run.values for run in runs], axis=0)
    np.testing.assert_allclose(np.mean([run.errors for run in runs], axis=0), spread, rtol=0.2)


@pytest.mark.parametrize(("offset", "worth"), [(0.0, False), (0.3, True)])
def test_a_constant_is_worth_keeping_if_it_is_not_neutral(offset, worth):
    """The false alarm: noise alone would have to help in sum and in most of the folds, which this seed does not."""
    whitened, blocks = line(5, 2.0, offset)
    found = fit([SLOPE, OFFSET], np.zeros(2), whitened, blocks)
    slope, constant = gains(found, folds([np.arange(400.0)], 5))
    assert is_worth(slope)
    assert is_worth(constant) == worth


def test_of_two_constants_that_do_the_same_one_is_given_up():
    whitened, blocks = line(1, 2.0, 0.0)
    twin = Constant("twin", 0.0, 1.0, -10.0, 10.0)
    found = fit([SLOPE, twin], np.zeros(2), lambda values: whitened(values[:1] + 0.999 * values[1:]), blocks)
    assert sum(map(is_worth, gains(found, folds([np.arange(400.0)], 5)))) == 1


def test_folds_are_logs_or_stretches_of_time():
    assert folds([np.arange(3.0), np.arange(2.0)], 5).tolist() == [0, 0, 0, 1, 1]
    assert folds([np.arange(4.0)], 2).tolist() == [0, 0, 1, 1]
