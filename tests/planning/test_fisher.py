"""Expected covariance along a path: against the motion model, numerical Jacobians, and the Monte-Carlo gain."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numerical import by_pose as numerical

from factorgraph_loc import Landmark, Rig, Tag, World
from factorgraph_loc.planning.information import (
    FINEST,
    expected_covariance,
    expected_gain,
    fisher_gain,
    gaussian_entropy,
)
from factorgraph_loc.planning.paths import Path, primitives
from factorgraph_loc.planning.sensors import Sensors
from factorgraph_loc.sensors.landmarks.simulation import LandmarkForecast
from factorgraph_loc.simulation.settings import RACKHAM_RIG
from factors import se2
from factors.landmarks import model as bearing_range
from factors.motion import ChainState
from factors.odometry.model import Growth, OdometryModel, relative_motion

RIG = Rig.model_validate(RACKHAM_RIG)
NOISE = OdometryModel(along=Growth(0.02), lateral=Growth(0.01), heading=Growth(0.03))
MEAN = np.array((1.0, 2.0, 0.7))
COVARIANCE = np.array(((0.04, 0.01, 0.002), (0.01, 0.03, -0.001), (0.002, -0.001, 0.01)))
STRAIGHT = next(p for p in primitives(4.0) if p.length > 3.9 and not p.poses[:, 1:].any())
STEP = Path(STRAIGHT.poses[:2], "arc")


def test_without_sensors_it_is_the_motion_model_alone():
    found = expected_covariance(MEAN, COVARIANCE, STRAIGHT, Sensors(NOISE))
    start, end = (ChainState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), ChainState(8.0, 4.0, 0.0, 0.0, 4.0, 0.0, 0.0))
    increment = relative_motion(NOISE, start, end)
    transition = se2.adjoint(se2.inverse(increment.delta))
    body = transition @ se2.world_to_body(MEAN, COVARIANCE) @ transition.T + increment.covariance
    expected = se2.body_to_world(se2.compose(MEAN, increment.delta), body)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-6)


def test_one_look_at_a_landmark_is_one_update_of_a_kalman_filter():
    world = World(landmarks={"L": Landmark(x=4.0, y=3.0), "far": Landmark(x=40.0, y=3.0)})
    model = RIG.bearing_range.model()
    sensors = Sensors(OdometryModel(), (LandmarkForecast(world, model, 1.0 / STEP.length),))
    end = se2.compose(MEAN, STEP.poses[-1])
    point = world.positions()[:1]
    jacobian = numerical(lambda p: np.concatenate(bearing_range.predict(model, p, point)), end)
    noise = np.diag(bearing_range.sigmas(model, bearing_range.predict(model, end, point)[0])[0] ** 2)
    transition = se2.adjoint(se2.inverse(STEP.poses[-1]))
    body = transition @ se2.world_to_body(MEAN, COVARIANCE) @ transition.T
    gain = body @ jacobian.T @ np.linalg.inv(jacobian @ body @ jacobian.T + noise)
    expected = se2.body_to_world(end, (np.eye(3) - gain @ jacobian) @ body)
    np.testing.assert_allclose(expected_covariance(MEAN, COVARIANCE, STEP, sensors), expected, rtol=1e-4, atol=1e-7)


def test_no_landmark_is_seen_through_a_wall():
    world = World(landmarks={"L": Landmark(x=4.0, y=2.0)}, walls=((2.5, -5.0, 2.5, 9.0),))
    forecast = LandmarkForecast(world, RIG.bearing_range.model())
    assert not forecast.information(np.array(((1.0, 2.0, 0.0),)), np.ones(1)).any()
    assert forecast.information(np.array(((3.0, 2.0, 0.0),)), np.ones(1)).any()


def tagged(*places):
    return World(tags={f"T{i}": Tag(x=float(x), y=float(y), z=1.2) for i, (x, y) in enumerate(places)})


@pytest.mark.parametrize("dims", [2, 3])
def test_it_agrees_with_the_monte_carlo_gain_where_the_belief_is_narrow(dims):
    """As narrow as the sensors are nearly linear, with tags at the end of their reach. What the Monte-Carlo gain does not count, as
    too fine, is added to the closed covariances too. The order of the paths is the same."""
    world, paths = tagged((4.8, 3.0), (-1.5, 5.5)), [p for p in primitives(1.5) if p.length > 1.4][::5]
    sensors = replace(Sensors.of(world, RIG), odometry=NOISE)
    covariance = np.diag((0.3**2, 0.3**2, 0.15**2))
    rng = np.random.default_rng(0)
    particles = rng.multivariate_normal(MEAN, covariance, 2000)
    weights = np.full(2000, 1.0 / 2000)
    drawn = expected_gain(sensors, particles, weights, paths, rng, dims=dims, noise=NOISE, samples=2000, scans=200)
    fine = np.diag(FINEST**2)
    after = np.array([expected_covariance(MEAN, covariance, path, sensors) for path in paths])
    closed = gaussian_entropy(covariance + fine, dims) - gaussian_entropy(after + fine, dims)
    assert abs(drawn - closed).max() < 0.2
    assert abs(np.mean(drawn - closed)) < 0.1
    assert np.corrcoef(drawn, closed)[0, 1] > 0.9
    assert np.ptp(closed) > 0.3


def test_the_gain_is_the_fall_of_entropy():
    sensors = Sensors.of(tagged((4.8, 3.0), (-1.5, 5.5)), RIG)
    (gain,) = fisher_gain(MEAN, COVARIANCE, [STRAIGHT], sensors)
    after = expected_covariance(MEAN, COVARIANCE, STRAIGHT, sensors)
    # of what is not finer than counts
    fine = np.diag(FINEST**2)
    before, left = (gaussian_entropy(covariance + fine, 2) for covariance in (COVARIANCE, after))
    assert gain == pytest.approx(before - left)
    assert fisher_gain(MEAN, COVARIANCE, [], sensors).shape == (0,)


def test_only_sensors_that_find_something_are_taken():
    nothing = Sensors.of(World(), RIG)
    assert nothing.forecasts == ()
    (gain,) = fisher_gain(MEAN, COVARIANCE, [STRAIGHT], nothing)
    assert gain < 0.0
    assert math.isfinite(gain)
