"""Late ranges: the mixture, its derivatives, its Gaussian replacement in a filter, and the learnt share and excess."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerical import by_each

from factors.landmarks.factor import BearingRangeFactor, landmark_update
from factors.landmarks.late import LEAST_INFORMATION, NONE, LateRanges, LateShares, mixture, moments
from factors.landmarks.model import BearingRangeModel
from factors.robust import geman_mcclure_loss, geman_mcclure_weight

LATE = LateRanges(0.2, 0.5, 0.2)
RADIO = BearingRangeModel(range_sigma=0.1, late=LATE)
lates = st.builds(LateRanges, st.floats(0.01, 0.6), st.floats(0.2, 5.0), st.floats(0.05, 5.0))
errors, slopes, robusts = st.floats(-40.0, 15.0), st.floats(0.5, 20.0), st.floats(1.0, 8.0)


@given(errors, slopes, robusts, lates)
def test_the_loss_is_that_of_a_mixture(error, slope, robust, late):
    width = 1.0 + (slope * late.sigma) ** 2
    parts = (
        (1.0 - late.share) * math.exp(-geman_mcclure_loss(error**2, robust)),
        late.share * math.exp(-geman_mcclure_loss((error + slope * late.mean) ** 2 / width, robust)) / math.sqrt(width),
    )
    loss, derivative, information = mixture(error, slope, robust, *late)
    assert loss == pytest.approx(-math.log(sum(parts)), abs=1e-9)
    step = 1e-5
    above, below = (mixture(error + sign * step, slope, robust, *late)[0] for sign in (1.0, -1.0))
    assert derivative == pytest.approx((above - below) / (2.0 * step), rel=1e-4, abs=1e-6)
    known = np.average(
        (
            geman_mcclure_weight(error**2, robust),
            geman_mcclure_weight((error + slope * late.mean) ** 2 / width, robust) / width,
        ),
        weights=parts,
    )
    assert LEAST_INFORMATION * known * (1.0 - 1e-9) <= information <= known * (1.0 + 1e-9)


@given(st.floats(-8.0, 4.0), slopes, st.floats(0.01, 30.0), lates)
def test_a_correction_has_the_moments_of_the_mixture(error, slope, variance, late):
    """By quadrature, without a robust loss and without a gate."""
    by_range = np.linspace(-12.0, 12.0, 40_001) * math.sqrt(variance)  # change of the prediction
    width = 1.0 + (slope * late.sigma) ** 2
    density = (1.0 - late.share) * np.exp(-0.5 * (error + by_range) ** 2)
    density += late.share * np.exp(-0.5 * (error + by_range + slope * late.mean) ** 2 / width) / math.sqrt(width)
    density *= np.exp(-0.5 * by_range**2 / variance)
    mean = np.average(by_range, weights=density)
    spread = np.average((by_range - mean) ** 2, weights=density)
    residual, weight, _ = moments(error, slope, variance, 1e6, 1e12, *late)
    assert weight > 0.0
    corrected = 1.0 / (1.0 / variance + weight)
    assert -corrected * weight * residual == pytest.approx(mean, rel=1e-3, abs=1e-3 * math.sqrt(variance))
    assert corrected == pytest.approx(min(spread, variance), rel=2e-3)


def sighting(model, ranges, bearings=None, **changes):
    """Beacons at three places."""
    points = np.array(((4.0, 0.0), (0.0, 3.0), (-3.0, -2.0)))[: len(ranges)]
    bearings = np.full(len(ranges), np.nan) if bearings is None else np.array(bearings)
    return BearingRangeFactor(model, points, np.array(ranges), bearings, **changes)


@pytest.mark.parametrize("kind", ["fixed", "displaced", "biased", "free"])
def test_a_factor_has_the_gradient_of_its_cost(kind):
    pose, late = np.array((0.1, -0.2, 0.4)), 4.25
    factor, values = sighting(RADIO, (late, 3.15, 3.9)), [pose]
    if kind == "displaced":
        factor = replace(factor, offset=np.array((0.2, 0.0, 0.3)), offset_covariance=0.01 * np.eye(3))
    if kind == "biased":
        factor, values = sighting(RADIO, (late,), biased=True), [pose, np.array((0.05,))]
    if kind == "free":
        factor, values = sighting(RADIO, (late,), free=True), [pose, np.array((4.1, 0.1))]
    residual, blocks = factor.linearize(values)
    for block, expected in zip(blocks, by_each(factor.cost, values, step=1e-5), strict=True):
        np.testing.assert_allclose(residual @ block, expected, rtol=1e-3, atol=1e-4)


def test_particles_and_graphs_have_the_same_likelihood():
    factor = sighting(RADIO, (4.6, 3.3, 3.0), (np.nan, np.nan, 0.3))
    poses = np.random.default_rng(3).normal(0.0, 0.3, (20, 3))
    costs = [factor.cost([pose]) for pose in poses]
    np.testing.assert_allclose(factor.log_likelihood(poses), -np.array(costs), rtol=1e-9)


def test_a_range_with_a_bearing_is_direct():
    measured = (4.6, 3.3), (0.0, 1.4)
    late, direct = sighting(RADIO, *measured), sighting(replace(RADIO, late=NONE), *measured)
    pose, covariance = np.zeros(3), 0.01 * np.eye(3)
    assert late.cost([pose]) == direct.cost([pose])
    np.testing.assert_array_equal(late.linearize([pose])[0], direct.linearize([pose])[0])
    updates = [landmark_update(f, pose, covariance, np.zeros(0), 3, 1) for f in (late, direct)]
    np.testing.assert_array_equal(updates[0].covariance, updates[1].covariance)


def test_a_late_range_hardly_moves_a_filter():
    """The beacon ahead is 4 m away. A late range is an excess; a range that is as much too short is not."""
    pose, covariance = np.zeros(3), 0.01 * np.eye(3)
    moved = {}
    for measured in (4.0, 4.6, 3.4):
        update = landmark_update(sighting(RADIO, (measured,)), pose, covariance, np.zeros(0), 3, 1)
        assert np.linalg.eigvalsh(covariance - update.covariance)[0] > -1e-12
        moved[measured] = update
    assert abs(moved[4.6].delta[0]) < 0.3 * abs(moved[3.4].delta[0])
    assert moved[4.6].covariance[0, 0] > moved[4.0].covariance[0, 0]
    assert moved[4.6].nis < moved[3.4].nis


def test_correcting_in_general_and_by_compiled_code_is_the_same():
    factor, pose, covariance = sighting(RADIO, (4.45, 3.0, 3.7)), np.zeros(3), 0.02 * np.eye(3)
    compiled = landmark_update(factor, pose, covariance, np.zeros(0), 3, 1)
    error, (by_pose,) = factor.resolved([pose], covariance).whitened([pose])
    stacked, residual = by_pose.reshape(-1, 3), error.ravel()
    corrected = np.linalg.inv(np.linalg.inv(covariance) + stacked.T @ stacked)
    np.testing.assert_allclose(compiled.covariance, corrected, rtol=1e-9)
    np.testing.assert_allclose(compiled.delta, -corrected @ stacked.T @ residual, rtol=1e-9)


def learnt(excess, share, noise=1.0, bias=0.0, count=400, seed=1, prior=0.1, sigma=0.1):
    """What is known after ``count`` ranges with a standard deviation of ``sigma`` [m], times ``noise``."""
    rng = np.random.default_rng(seed)
    late = excess * (rng.random(count) < share) + bias
    errors = -(noise * rng.standard_normal(count) + late / sigma)
    shares = LateShares(prior)
    for first in range(0, count, 4):
        part = slice(first, first + 4)
        shares = shares.updated(errors[part], np.full(4, 1.0 / sigma), np.full(4, 0.2))
    return shares


@pytest.mark.parametrize(("excess", "share"), [(0.5, 0.2), (1.0, 0.1), (3.0, 0.4)])
def test_share_and_excess_are_learnt(excess, share):
    found = learnt(excess, share).expected
    assert found.share == pytest.approx(share, rel=0.4)
    assert found.mean == pytest.approx(excess, rel=0.4)


@pytest.mark.parametrize("noise", [0.5, 1.0, 1.5])
@pytest.mark.parametrize("bias", [0.0, 0.5])
def test_other_errors_are_not_taken_for_late_ranges(noise, bias):
    """A noise that is smaller or larger than stated, and a bias of all ranges."""
    assert learnt(0.0, 0.0, noise, bias).expected.share < 0.01


def test_gross_errors_on_both_sides_are_not_taken_for_late_ranges():
    shares, rng = LateShares(0.1), np.random.default_rng(4)
    errors = rng.standard_normal(400) + 12.0 * rng.choice((-1.0, 0.0, 1.0), 400, p=(0.03, 0.94, 0.03))
    assert shares.updated(errors, np.full(400, 10.0), np.full(400, 0.2)).expected.share < 0.03


def test_before_any_range_few_are_late_and_none_without_a_prior():
    assert 0.002 < LateShares(0.1).expected.share < 0.03
    assert learnt(0.5, 0.2, prior=0.0).expected == NONE
    assert LateShares(0.1).updated(np.zeros(2), np.zeros(2), np.zeros(2)).log_weights is None


def test_a_gross_error_leaves_finite_probabilities():
    shares = LateShares(0.1).updated(np.array((-1e9, 1e9)), np.full(2, 10.0), np.zeros(2))
    assert np.isfinite(shares.log_weights).all()
    assert np.exp(shares.log_weights).sum() == pytest.approx(1.0)
