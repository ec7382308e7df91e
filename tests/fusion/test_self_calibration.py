"""Constants of odometry and sensor that are estimated on the way, against least squares."""

import numpy as np
import pytest

from factorgraph_loc import BearingRange, IncrementOdometry, Landmark, Rig, Tick, World
from factorgraph_loc.fusion.registry import create, settings_of
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings, BearingRangeUncertainty
from factorgraph_loc.sensors.odometry.settings import (
    GrowthSettings,
    OdometryNoise,
    OdometrySettings,
    OdometryUncertainty,
)

# A landmark so far ahead that its range measures x: with the wheels' scale and the sensor's place ahead of the robot's centre a
# linear and Gaussian problem.
FAR = World(landmarks={"far": Landmark(x=1e4, y=0.0)})
STEP, STEPS, ALONG, NOISE = 0.5, 30, 0.1, 0.3  # m, -, m per sqrt(m), m
PRIOR, SCALE, AHEAD = 0.2, 0.1, 0.4  # standard deviations of the start [m], the scale, the sensor's place [m]
STIFF = GrowthSettings(per_distance=1e-6)
LINEAR = Rig(
    odometry=OdometrySettings(
        noise=OdometryNoise(along=GrowthSettings(per_distance=ALONG), lateral=STIFF, heading=STIFF),
        uncertainty=OdometryUncertainty(scale_distance=SCALE),
    ),
    bearing_range=BearingRangeSettings(range_sigma=NOISE, robust=100.0, uncertainty=BearingRangeUncertainty(x=AHEAD)),
)


def least_squares(ranges):
    """Mean and covariance of the scale, the sensor's place and all positions along x: rows of a Jacobian and what they measure."""
    rows = [np.eye(STEPS + 3)[i] / sigma for i, sigma in enumerate((SCALE, AHEAD, PRIOR))]
    measured = [0.0, 0.0, 0.0]
    for i, seen in enumerate(ranges, start=1):
        moved = np.zeros(STEPS + 3)
        moved[2 + i], moved[1 + i], moved[0] = 1.0, -1.0, -STEP
        rows.append(moved / (ALONG * np.sqrt(STEP)))
        measured.append(STEP / (ALONG * np.sqrt(STEP)))
        looked = np.zeros(STEPS + 3)
        looked[2 + i], looked[1] = 1.0, 1.0
        rows.append(looked / NOISE)
        measured.append((1e4 - seen) / NOISE)
    mean, *_ = np.linalg.lstsq(np.array(rows), np.array(measured), rcond=None)
    return mean, np.linalg.inv(np.array(rows).T @ np.array(rows))


@pytest.mark.parametrize("name", ["ekf", "smoother", "batch"])
def test_a_linear_gaussian_run_is_that_of_least_squares(name):
    rng = np.random.default_rng(5)
    truth = np.cumsum(1.08 * STEP + rng.normal(scale=ALONG * np.sqrt(STEP), size=STEPS))
    ranges = 1e4 - truth - 0.3 + rng.normal(scale=NOISE, size=STEPS)
    mean, covariance = least_squares(ranges)
    setup = Setup(LINEAR, FAR, ("odometry", "bearing_range"), np.random.default_rng(0))
    estimator = create(name, setup, settings_of(name, {}))
    estimator.initialize(PosePrior(0.0, np.zeros(3), np.diag((PRIOR, 1e-4, 1e-5)) ** 2))
    estimator.process(IncrementOdometry(0.0, 0.0, 0.0, 0.0))
    for i, seen in enumerate(ranges, start=1):
        estimator.process(IncrementOdometry(STEP * i, STEP, 0.0, 0.0))
        estimator.process(BearingRange(STEP * i, ("far",), np.array([seen]), np.array([np.nan])))
        estimator.process(Tick(STEP * i))
    final, learnt = estimator.trajectory(), estimator.learnt().values
    np.testing.assert_allclose(final.poses[:, 0], mean[3:], atol=2e-3)
    np.testing.assert_allclose(final.covariances[:, 0, 0], np.diag(covariance)[3:], rtol=2e-2)
    for i, constant in enumerate(("scale_distance", "bearing_range.x")):
        value, sigma = learnt[constant]
        assert value == pytest.approx(mean[i], abs=2e-3)
        assert sigma == pytest.approx(np.sqrt(covariance[i, i]), rel=2e-2)
