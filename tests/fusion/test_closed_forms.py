"""Estimators against what is known in closed form."""

import numpy as np
import pytest

from factorgraph_loc import BearingRange, IncrementOdometry, Landmark, Rig, Tick, World
from factorgraph_loc.fusion.registry import create, settings_of
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factorgraph_loc.sensors.odometry.settings import (
    GrowthSettings,
    OdometryNoise,
    OdometrySettings,
)
from factors import se2
from factors.landmarks.model import log_likelihood

# Landmarks so far ahead that range measures x and bearing measures heading: the problem along x is linear and Gaussian.
FAR = World(landmarks={"far": Landmark(x=1e4, y=0.0)})
ALONG = GrowthSettings(per_distance=0.1)
STIFF = GrowthSettings(per_distance=1e-6)
LINEAR = Rig(
    odometry=OdometrySettings(noise=OdometryNoise(along=ALONG, lateral=STIFF, heading=STIFF)),
    bearing_range=BearingRangeSettings(range_sigma=0.3, bearing_sigma=0.5, robust=100.0),
)
STEPS = 30
PRIOR_SIGMAS = np.array((0.2, 1e-4, 1e-5))


def make(name, rig, world, **settings):
    setup = Setup(rig, world, ("odometry", "bearing_range"), np.random.default_rng(7))
    return create(name, setup, settings_of(name, settings))


def drive(estimator, ranges):
    """Steps of 0.5 m in 0.5 s along x, a range after each; causal x and variance of x at each step."""
    estimator.initialize(PosePrior(0.0, np.zeros(3), np.diag(PRIOR_SIGMAS**2)))
    estimator.process(IncrementOdometry(0.0, 0.0, 0.0, 0.0))
    causal = []
    for i, measured in enumerate(ranges, start=1):
        t = 0.5 * i
        estimator.process(IncrementOdometry(t, 0.5, 0.0, 0.0))
        estimator.process(BearingRange(t, ("far",), np.array([measured]), np.array([np.nan])))
        estimator.process(Tick(t))
        estimate = estimator.estimate()
        causal.append((estimate.pose[0], estimate.covariance[0, 0]))
    return np.array(causal)


def kalman(ranges):
    """The Kalman filter and the Rauch-Tung-Striebel smoother of the scalar problem: rows of (mean, variance)."""
    mean, variance = 0.0, PRIOR_SIGMAS[0] ** 2
    predicted, filtered = [], []
    for measured in ranges:
        mean, variance = mean + 0.5, variance + 0.1**2 * 0.5
        predicted.append((mean, variance))
        gain = variance / (variance + 0.3**2)
        mean, variance = mean + gain * (1e4 - measured - mean), (1.0 - gain) * variance
        filtered.append((mean, variance))
    smoothed = [filtered[-1]]
    for (m, v), (pm, pv) in zip(filtered[-2::-1], predicted[:0:-1], strict=True):
        gain = v / pv
        after_m, after_v = smoothed[0]
        smoothed.insert(0, (m + gain * (after_m - pm), v + gain**2 * (after_v - pv)))
    return np.array(filtered), np.array(smoothed)


@pytest.fixture
def ranges():
    rng = np.random.default_rng(3)
    truth = np.cumsum(0.5 + rng.normal(scale=0.1 * np.sqrt(0.5), size=STEPS))
    return 1e4 - truth + rng.normal(scale=0.3, size=STEPS)


@pytest.mark.parametrize("name", ["ekf", "smoother", "smoother with a long window", "batch"])
def test_a_linear_gaussian_run_is_that_of_the_kalman_filter_and_smoother(name, ranges):
    filtered, smoothed = kalman(ranges)
    estimator = make(name.split()[0], LINEAR, FAR, **({"lag": 100.0} if "window" in name else {}))
    causal = drive(estimator, ranges)
    if name != "batch":  # which has no causal result
        np.testing.assert_allclose(causal[:, 0], filtered[:, 0], atol=2e-3)
        np.testing.assert_allclose(causal[:, 1], filtered[:, 1], rtol=2e-2)
    final = estimator.trajectory()
    np.testing.assert_allclose(final.poses[:, 0], smoothed[:, 0], atol=2e-3)
    np.testing.assert_allclose(final.covariances[:, 0, 0], smoothed[:, 1], rtol=2e-2)


def test_a_particle_filter_comes_near_the_kalman_filter_and_smoother(ranges):
    ranges = ranges[:15]
    filtered, smoothed = kalman(ranges)
    estimator = make(
        "particle_filter", LINEAR, FAR, particles=10_000, smoothing_interval=0.5, smoothing_trajectories=1000
    )
    causal = drive(estimator, ranges)
    # the mean of N particles of spread s is off by s / sqrt(N_eff): 6 sigma of 2,000 effective ones, below 1e-7 of false alarms
    bound = 6.0 * np.sqrt(filtered[:, 1] / 2000.0)
    assert np.all(np.abs(causal[:, 0] - filtered[:, 0]) < bound)
    np.testing.assert_allclose(causal[:, 1], filtered[:, 1], rtol=0.15)
    final = estimator.trajectory()
    assert np.all(np.abs(final.poses[:, 0] - smoothed[:, 0]) < 6.0 * np.sqrt(smoothed[:, 1] / 500.0))
    np.testing.assert_allclose(final.covariances[:, 0, 0], smoothed[:, 1], rtol=0.3)


def test_particles_match_the_grid_posterior_of_one_beacon():
    """One range to one beacon from a wide prior: a ring, far from Gaussian; the particles must have the grid's moments."""
    world = World(landmarks={"beacon": Landmark(x=1.0, y=0.5)})
    rig = Rig(bearing_range=BearingRangeSettings(range_sigma=0.2, robust=3.0))
    estimator = make("particle_filter", rig, world, particles=100_000, resample_below=1e-6 + 0.0)
    sigmas = np.array((1.0, 0.8, 0.3))
    estimator.initialize(PosePrior(0.0, np.zeros(3), np.diag(sigmas**2)))
    estimator.process(BearingRange(0.0, ("beacon",), np.array([1.5]), np.array([np.nan])))

    x, y = np.meshgrid(np.linspace(-6, 6, 601), np.linspace(-5, 5, 501), indexing="ij")
    cells = np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size)))
    log_density = -0.5 * ((cells[:, 0] / sigmas[0]) ** 2 + (cells[:, 1] / sigmas[1]) ** 2)
    log_density += log_likelihood(
        rig.bearing_range.model(), cells, np.array([[1.0, 0.5]]), np.array([1.5]), np.array([np.nan])
    )
    weights = np.exp(log_density - log_density.max())
    weights /= weights.sum()
    mean = weights @ cells[:, :2]
    covariance = (cells[:, :2] - mean).T @ (weights[:, None] * (cells[:, :2] - mean))

    estimate = estimator.estimate()
    # about 20,000 effective particles of spread 0.8: 6 sigma is 0.035, below 1e-8 of false alarms
    np.testing.assert_allclose(estimate.pose[:2], mean, atol=0.035)
    np.testing.assert_allclose(estimate.covariance[:2, :2], covariance, atol=0.05)
    assert np.linalg.eigvalsh(covariance).min() > 0.2  # the ring has not collapsed to one side


@pytest.mark.parametrize("name", ["ekf", "particle_filter", "smoother"])
def test_one_look_is_no_better_than_the_map(name):
    """Five landmarks, each surveyed to 0.3 m, tell x and y to 0.3 / sqrt(5) m, however good the sensor is.

    5000 particles tell a standard deviation to 1 % (one sigma); the noise of sensor and prior adds less than 2 %.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, 5, endpoint=False)
    places = 4.0 * np.column_stack((np.cos(angles), np.sin(angles)))
    landmarks = {f"l{i}": Landmark(x=x, y=y, sigma=0.3) for i, (x, y) in enumerate(places.tolist())}
    rig = Rig(bearing_range=BearingRangeSettings(range_sigma=0.03, bearing_sigma=0.01, robust=100.0))
    estimator = make(name, rig, World(landmarks=landmarks))
    estimator.initialize(PosePrior(0.0, np.zeros(3), np.diag((1.0, 1.0, 0.3)) ** 2))
    estimator.process(IncrementOdometry(0.0, 0.0, 0.0, 0.0))
    estimator.process(BearingRange(0.0, tuple(landmarks), np.full(5, 4.0), se2.wrap(angles)))
    found = np.sqrt(np.diag(estimator.estimate().covariance))
    np.testing.assert_allclose(found[:2], 0.3 / np.sqrt(5.0), rtol=0.08)
    assert found[2] == pytest.approx(0.3 / 4.0 / np.sqrt(5.0), rel=0.1)
