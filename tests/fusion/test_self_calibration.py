"""Constants of odometry and sensor that are estimated on the way, on simulated runs whose constants are not the rig's."""

from dataclasses import replace

import numpy as np
import pytest
from landmark_world import DEPTH, TRUTH, miscalibrated, simulate

from factorgraph_loc import BearingRange, IncrementOdometry, Landmark, Rig, Tick, World
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
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

CONFIGS = {
    "ekf": RunConfig("ekf"),
    "smoother": RunConfig("smoother"),
    "smoother_lag": RunConfig("smoother", {"lag": 5.0}),
    "batch": RunConfig("batch"),
}


@pytest.fixture(scope="module")
def logs():
    """By whether ranges are depths: a log, and the truth."""
    log = simulate(seconds=40.0)
    return {depth: (miscalibrated(log, t, depth=depth), t) for depth, t in ((False, TRUTH), (True, DEPTH))}


@pytest.mark.parametrize(("name", "depth"), [("ekf", True), ("smoother", False), ("batch", True)])
def test_constants_are_found(name, depth, logs):
    """One of the nine constants lies beyond 3.5 sigma in one of 240 simulations; the estimators err together."""
    log, truth = logs[depth]
    result = run(log, CONFIGS[name])
    assert set(result.learnt.values) == set(truth)
    for constant, expected in truth.items():
        value, sigma = result.learnt.values[constant]
        assert abs(value - expected) < 3.5 * sigma, constant
        assert sigma < 0.25 * 2.0 * abs(expected), constant
    off = run(log, replace(CONFIGS[name], settings={**CONFIGS[name].settings, "self_calibration": False}))
    assert off.learnt.values == {}
    for kind in ("final",) if name == "batch" else ("causal", "final"):
        with_constants, without = (score(r, log)[f"{kind}.position_rmse"] for r in (result, off))
        assert with_constants < 0.1
        assert without > 3.0 * with_constants


@pytest.mark.parametrize("name", ["ekf", "smoother_lag"])
def test_right_constants_stay(name):
    """As above, with a rig that is right and does not know it: 3.5 sigma of seven constants, one of 300 simulations."""
    log = miscalibrated(simulate(seconds=40.0, seed=2), TRUTH, seed=2)
    right = miscalibrated(simulate(seconds=40.0, seed=2), dict.fromkeys(TRUTH, 0.0), seed=2)
    log = replace(right, rig=log.rig)
    result = run(log, CONFIGS[name])
    for constant, (value, sigma) in result.learnt.values.items():
        assert abs(value) < 3.5 * sigma, constant
    known = run(right, CONFIGS[name])
    assert known.learnt.values == {}
    assert score(result, log)["final.position_rmse"] < 1.5 * score(known, log)["final.position_rmse"] + 0.01


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
