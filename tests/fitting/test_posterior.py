"""Maximum a posteriori estimates on a straight line."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.fitting.posterior import Parameter, independent_share, least_squares, maximise
from factorgraph_loc.fitting.shares import wilson

LINE = (Parameter("slope", 0.0, 1.0, -10.0, 10.0), Parameter("offset", 0.0, 1.0, -10.0, 10.0))


def line(seed, slope, offset, outliers=0.0, count=400):
    """Residuals of a line through noisy points, in standard deviations, as a function of slope and offset; and blocks."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, count)
    y = slope * x + offset + 0.1 * rng.standard_normal(count)
    y[rng.random(count) < outliers] = 50.0
    return lambda values: ((values[0] * x + values[-1] * (len(values) > 1) - y) / 0.1)[:, None], np.arange(count)


def fitted(parameters, whitened, blocks):
    return maximise(parameters, least_squares(whitened, parameters, blocks))


def test_outliers_move_the_fit_by_little():
    """3 % of outliers, all on one side, move the offset by about 0.1 * 2 * 0.03; the mean would move by 1.5."""
    np.testing.assert_allclose(fitted(LINE, *line(1, 2.0, 0.5, outliers=0.03)).values, (2.0, 0.5), atol=0.04)


def test_standard_deviations_are_those_of_repetitions():
    """The ratio over 200 repetitions has a standard error of 5 %: 20 % are four."""
    runs = [fitted(LINE, *line(seed, 2.0, 0.5, count=100)) for seed in range(200)]
    scatter = np.std([run.values for run in runs], axis=0)
    np.testing.assert_allclose(np.mean([run.errors for run in runs], axis=0), scatter, rtol=0.2)


def test_priors_may_be_correlated():
    """A parameter without data follows another one as the prior says."""
    whitened, blocks = line(1, 2.0, 0.0)
    pair = [LINE[0], replace(LINE[0], name="unseen", mean=3.0, sigma=2.0)]
    covariance = np.array(((LINE[0].sigma ** 2, 0.5), (0.5, 4.0)))
    likelihood = least_squares(lambda values: whitened(values[:1]), pair, blocks)
    slope, unseen = maximise(pair, likelihood, covariance=covariance).values
    assert unseen - 3.0 == pytest.approx(0.5 / LINE[0].sigma ** 2 * (slope - LINE[0].mean), rel=1e-3)


def test_parameters_that_do_the_same_move_together():
    """Their sum is known, each by its prior only; without data a parameter keeps the prior."""
    whitened, blocks = line(1, 2.0, 0.0)
    twins = [LINE[0], replace(LINE[0], name="twin", sigma=2.0), replace(LINE[0], name="unseen", mean=3.0)]
    twin_fit = fitted(twins, lambda values: whitened(values[:1] + values[1:2]), blocks)
    np.testing.assert_allclose(twin_fit.values, (0.4, 1.6, 3.0), atol=0.02)
    assert twin_fit.errors[2] == pytest.approx(1.0)
    ((first, second, correlation),) = twin_fit.correlations()
    assert (first, second) == ("slope", "twin")
    assert correlation < -0.99


def test_measurements_that_are_repeated_count_once():
    """Each four times over, in its block: the share is a quarter, with a standard error of a tenth."""
    whitened, blocks = line(3, 2.0, 0.5)
    once, often = (
        fitted(LINE, lambda values, n=n: np.repeat(whitened(values), n, axis=0), np.repeat(blocks, n)) for n in (1, 4)
    )
    assert often.share == pytest.approx(0.25, rel=0.3)
    np.testing.assert_allclose(often.errors, once.errors, rtol=0.15)
    assert independent_share(np.zeros((3, 2)), np.eye(2)) == 1.0


def test_wilson_agrees_with_its_published_figures():
    """Newcombe, Statistics in Medicine 17(8), 1998, table I: 81 of 263, 15 of 148, 0 of 20, 1 of 29."""
    for counts, expected in (
        ((81, 263), (0.2553, 0.3662)),
        ((15, 148), (0.0624, 0.1605)),
        ((0, 20), (0.0, 0.1611)),
        ((1, 29), (0.0061, 0.1718)),
    ):
        assert wilson(*counts) == pytest.approx(expected, abs=6e-5)
