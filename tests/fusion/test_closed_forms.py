"""Estimators against what is known in closed form: poses, and constants of odometry and sensor."""

from dataclasses import replace

import numpy as np
import pytest
from by_hand import made
from on_a_line import STEP, WHEELS, drive, kalman

from factorgraph_loc import BearingRange, IncrementOdometry, Landmark, Rig, World
from factorgraph_loc.fusion.graph.problem import Chained, Problem
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings, BearingRangeUncertainty
from factorgraph_loc.sensors.odometry.settings import OdometryUncertainty
from factors import se2
from factors.graph import PriorFactor, VectorPriorFactor, constants_key, landmark_key, pose_key
from factors.landmarks.factor import BearingRangeFactor
from factors.landmarks.model import PARAMETERS, BearingRangeModel, log_likelihood
from factors.motion import Increment
from factors.odometry.factor import OdometryFactor

# Landmarks so far ahead that range measures x and bearing measures heading: the problem along x is linear and Gaussian.
FAR = World(landmarks={"far": Landmark(x=1e4, y=0.0)})
SENSOR = BearingRangeSettings(range_sigma=0.3, bearing_sigma=0.5, robust=100.0, late=0.0)  # Gaussian
LINEAR = Rig(odometry=WHEELS, bearing_range=SENSOR)
STEPS, SENSORS = 30, ("odometry", "bearing_range")
PRIOR_SIGMAS = np.array((0.2, 1e-4, 1e-5))
SCALE, AHEAD = 0.1, 0.4  # standard deviations of the wheels' scale, and of how far ahead the sensor sits [m]


def ranged(estimator, ranges):
    """The causal x and its variance, by steps of half a metre with a range after each."""
    measurements = (
        BearingRange(STEP * i, ("far",), np.array([r]), np.array([np.nan])) for i, r in enumerate(ranges, start=1)
    )
    return drive(estimator, PRIOR_SIGMAS, 0.5, measurements)


def measured(seed, step=0.5):
    """Ranges to the far landmark of a robot that moves by ``step`` [m] at a time, with noise."""
    rng = np.random.default_rng(seed)
    truth = np.cumsum(step + rng.normal(scale=0.1 * np.sqrt(0.5), size=STEPS))
    return 1e4 - truth + rng.normal(scale=0.3, size=STEPS)


@pytest.fixture
def ranges():
    return measured(3)


@pytest.mark.parametrize("name", ["ekf", "smoother", "smoother with a long window", "batch"])
def test_a_linear_gaussian_run_is_that_of_the_kalman_filter_and_smoother(name, ranges):
    filtered, smoothed = kalman(1e4 - ranges, PRIOR_SIGMAS, 0.5, 0.3**2)
    estimator = made(name.split()[0], LINEAR, FAR, SENSORS, **({"lag": 100.0} if "window" in name else {}))
    causal = ranged(estimator, ranges)
    if name != "batch":  # which has no causal result
        np.testing.assert_allclose(causal[:, 0], filtered[:, 0], atol=2e-3)
        np.testing.assert_allclose(causal[:, 1], filtered[:, 1], rtol=2e-2)
    final = estimator.trajectory()
    np.testing.assert_allclose(final.poses[:, 0], smoothed[:, 0], atol=2e-3)
    np.testing.assert_allclose(final.covariances[:, 0, 0], smoothed[:, 1], rtol=2e-2)


def test_a_particle_filter_comes_near_the_kalman_filter_and_smoother(ranges):
    ranges = ranges[:15]
    filtered, smoothed = kalman(1e4 - ranges, PRIOR_SIGMAS, 0.5, 0.3**2)
    estimator = made(
        "particle_filter",
        LINEAR,
        FAR,
        SENSORS,
        7,
        particles=10_000,
        smoothing_interval=0.5,
        smoothing_trajectories=1000,
    )
    causal = ranged(estimator, ranges)
    # the mean of N particles of spread s is off by s / sqrt(N_eff): 6 sigma of 2,000 effective ones, below 1e-7 of false alarms
    bound = 6.0 * np.sqrt(filtered[:, 1] / 2000.0)
    assert np.all(np.abs(causal[:, 0] - filtered[:, 0]) < bound)
    np.testing.assert_allclose(causal[:, 1], filtered[:, 1], rtol=0.15)
    final = estimator.trajectory()
    assert np.all(np.abs(final.poses[:, 0] - smoothed[:, 0]) < 6.0 * np.sqrt(smoothed[:, 1] / 500.0))
    np.testing.assert_allclose(final.covariances[:, 0, 0], smoothed[:, 1], rtol=0.3)


def least_squares(ranges):
    """Mean and covariance of the scale, the sensor's place and all positions along x: rows of a Jacobian and what they measure."""
    rows = [np.eye(STEPS + 3)[i] / sigma for i, sigma in enumerate((SCALE, AHEAD, PRIOR_SIGMAS[0]))]
    values, wheels = [0.0, 0.0, 0.0], 0.1 * np.sqrt(0.5)
    for i, seen in enumerate(ranges, start=1):
        moved, looked = np.zeros((2, STEPS + 3))
        moved[2 + i], moved[1 + i], moved[0] = 1.0, -1.0, -0.5
        looked[2 + i], looked[1] = 1.0, 1.0
        rows += [moved / wheels, looked / 0.3]
        values += [0.5 / wheels, (1e4 - seen) / 0.3]
    mean, *_ = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)
    return mean, np.linalg.inv(np.array(rows).T @ np.array(rows))


@pytest.mark.parametrize("name", ["ekf", "smoother", "batch"])
def test_constants_that_are_estimated_on_the_way_are_those_of_least_squares(name):
    ranges = measured(5, step=1.08 * 0.5) - 0.3
    mean, covariance = least_squares(ranges)
    wheels = WHEELS.model_copy(update={"uncertainty": OdometryUncertainty(scale_distance=SCALE)})
    sensor = SENSOR.model_copy(update={"uncertainty": BearingRangeUncertainty(x=AHEAD)})
    estimator = made(name, Rig(odometry=wheels, bearing_range=sensor), FAR, SENSORS)
    ranged(estimator, ranges)
    final, learnt = estimator.trajectory(), estimator.learnt().values
    np.testing.assert_allclose(final.poses[:, 0], mean[3:], atol=2e-3)
    np.testing.assert_allclose(final.covariances[:, 0, 0], np.diag(covariance)[3:], rtol=2e-2)
    for i, constant in enumerate(("scale_distance", "bearing_range.x")):
        value, sigma = learnt[constant]
        assert value == pytest.approx(mean[i], abs=2e-3)
        assert sigma == pytest.approx(np.sqrt(covariance[i, i]), rel=2e-2)


def test_particles_match_the_grid_posterior_of_one_beacon():
    """One range to one beacon from a wide prior: a ring, far from Gaussian; the particles must have the grid's moments."""
    world = World(landmarks={"beacon": Landmark(x=1.0, y=0.5)})
    rig = Rig(bearing_range=BearingRangeSettings(range_sigma=0.2, robust=3.0))
    estimator = made("particle_filter", rig, world, SENSORS, 7, particles=100_000, resample_below=1e-6 + 0.0)
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
    estimator = made(name, rig, World(landmarks=landmarks), SENSORS, 7)
    estimator.initialize(PosePrior(0.0, np.zeros(3), np.diag((1.0, 1.0, 0.3)) ** 2))
    estimator.process(IncrementOdometry(0.0, 0.0, 0.0, 0.0))
    estimator.process(BearingRange(0.0, tuple(landmarks), np.full(5, 4.0), se2.wrap(angles)))
    found = np.sqrt(np.diag(estimator.estimate().covariance))
    np.testing.assert_allclose(found[:2], 0.3 / np.sqrt(5.0), rtol=0.08)
    assert found[2] == pytest.approx(0.3 / 4.0 / np.sqrt(5.0), rel=0.1)


ODOMETRY, BEAM = constants_key(0), constants_key(1)
MODEL = BearingRangeModel(mounting=(0.1, -0.05, 0.2), range_scale=1.03, depth=True, bearing_bias=0.01, robust=3.0)
POINTS = np.array(((4.0, 1.0), (5.0, -2.0), (3.0, 3.0), (6.0, 0.5)))


def look(rng, pose, **more):
    """What is seen of the points, one of them without a range and one without a bearing, the last far off."""
    at = se2.compose(se2.compose(pose, more.get("offset", np.zeros(3))), np.array(MODEL.mounting))
    local = se2.transform_to(at, POINTS)
    ranges, bearings = MODEL.range_scale * local[:, 0], np.arctan2(local[:, 1], local[:, 0]) + MODEL.bearing_bias
    ranges, bearings = ranges + 0.05 * rng.standard_normal(4), bearings + 0.02 * rng.standard_normal(4)
    ranges[0], bearings[1], ranges[3] = np.nan, np.nan, ranges[3] + 2.0
    return BearingRangeFactor(MODEL, POINTS, ranges, bearings, **more)


@pytest.fixture
def run():
    """Eight poses; what looks may have beside their points, each once."""
    rng = np.random.default_rng(3)
    step, covariance = np.array((0.3, 0.02, 0.1)), np.diag((0.02, 0.01, 0.02)) ** 2
    spreads = np.array([np.diag((0.1, 0.2)) ** 2] * 4)
    offset = {"offset": np.array((0.05, 0.01, 0.03)), "offset_covariance": np.diag((0.05, 0.04, 0.06)) ** 2}
    twist = {"twist": np.array((0.5, 0.0, 0.3))}
    extras = [{}, twist, offset, {**offset, **twist, "simultaneous": 7}, {"point_covariances": spreads}]
    extras.append({**offset, "point_covariances": spreads})
    constants = tuple(range(len(PARAMETERS)))
    factors = [(PriorFactor(np.zeros(3), covariance), (pose_key(0),))]
    factors += [(VectorPriorFactor(np.zeros(2), np.array((0.02, 0.01))), (ODOMETRY,))]
    factors += [(VectorPriorFactor(np.zeros(6), np.full(6, 0.02)), (BEAM,))]
    pose, values = np.zeros(3), {ODOMETRY: np.array((0.01, -0.02)), BEAM: 0.01 * np.arange(6.0)}
    for i in range(8):
        if i:
            moved = Increment(step + 0.01 * rng.standard_normal(3), covariance, 0.5, 0.1)
            factors.append((OdometryFactor(moved, (0, 2)), (pose_key(i - 1), pose_key(i), ODOMETRY)))
        factors.append((look(rng, pose, estimated=constants, **extras[i % 6]), (pose_key(i), BEAM)))
        values[pose_key(i)] = se2.compose(pose, se2.exp(0.05 * rng.standard_normal(3)))
        pose = se2.compose(pose, step)
    return factors, values


def through_gtsam(factors):
    """The same problem, which is not told that it is a row."""
    problem = Problem(factors)
    problem.__dict__["_chain"] = None
    return problem


def test_the_solution_and_its_covariances_are_those_of_gtsams_elimination(run):
    factors, values = run
    ours, theirs = Problem(factors), through_gtsam(factors)
    assert ours._chain is not None
    assert ours._chain.cost(ours._chain.begin(values)) == pytest.approx(theirs.cost(values), rel=1e-12)
    found, expected = ours.solve(values), theirs.solve(values)
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    assert found.cost < 0.9 * theirs.cost(values)
    spreads, wanted = ours.covariances(expected.values, values), theirs.covariances(expected.values, values)
    for key, value in expected.values.items():
        np.testing.assert_allclose(found.values[key], value, atol=1e-8)
        np.testing.assert_allclose(spreads.by_key[key], wanted.by_key[key], rtol=1e-6, atol=1e-12)


def test_one_call_linearises_as_each_factor_does(run):
    """As the plain code of landmarks that are variables does, one by one."""
    factors, values = run
    for factor, keys in factors:
        if not isinstance(factor, BearingRangeFactor):
            continue
        at = [values[key] for key in keys]
        residual, found = factor.linearize(at)
        for i, point in enumerate(factor.points):
            spread = None if factor.point_covariances is None else factor.point_covariances[i : i + 1]
            seen = {"ranges": factor.ranges[i : i + 1], "bearings": factor.bearings[i : i + 1]}
            one = replace(
                factor, **seen, point_covariances=spread, free=True, simultaneous=factor.simultaneous or len(POINTS)
            )
            error, (*blocks, _) = one.linearize([*at, point])
            rows = slice(2 * i, 2 * i + 2)
            np.testing.assert_allclose(residual[rows], error, atol=1e-12)
            for block, expected in zip(found, blocks, strict=True):
                np.testing.assert_allclose(block[rows], expected, atol=1e-12)


def test_loops_and_many_parameters_are_left_to_gtsam(run):
    factors, values = run
    closing = OdometryFactor(Increment(np.zeros(3), np.eye(3), 1.0))
    assert Problem([*factors, (closing, (pose_key(1), pose_key(5)))])._chain is None
    extra = {landmark_key(i): np.zeros(2) for i in range(20)}
    many = [(VectorPriorFactor(np.zeros(2), np.ones(2)), (key,)) for key in extra]
    assert Chained([*factors, *many]).begin(values | extra) is None
