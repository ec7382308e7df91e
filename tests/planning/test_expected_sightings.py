"""Landmarks that would be seen on the way."""

import math
from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc import Landmark, Rig, World
from factorgraph_loc.planning.information import FINEST, expected_covariance, expected_gain, gaussian_entropy
from factorgraph_loc.planning.paths import primitives
from factorgraph_loc.planning.sensors import Sensors
from factorgraph_loc.sensors.landmarks.measurement import SightingSettings
from factorgraph_loc.simulation.settings import RACKHAM_RIG
from factors.landmarks import model as bearing_range

RIG = Rig.model_validate(RACKHAM_RIG)
MEAN = np.array((1.0, 2.0, 0.7))
NOTHING = Sensors.of(World(), RIG)


def forecast_of(*points, walls=()):
    world = World(landmarks={f"L{i}": Landmark(x=x, y=y) for i, (x, y) in enumerate(points)}, walls=walls)
    (only,) = Sensors.of(world, RIG).forecasts
    return only


def test_it_agrees_with_the_closed_form_where_the_belief_is_narrow():
    """Two landmarks, one or both of which are within 6 m along each way: the sensor is nearly linear over the belief. The odometry
    is exact, so the fall of entropy is that of the sightings alone."""
    seen = forecast_of((4.8, 3.0), (-1.5, 5.5))
    seen = replace(seen, model=replace(seen.model, range_sigma=0.6, bearing_sigma=0.4))
    still = replace(NOTHING, forecasts=(seen,))
    exact = replace(still, odometry=type(still.odometry)())
    covariance = np.diag((0.2**2, 0.2**2, 0.1**2))
    rng = np.random.default_rng(0)
    particles = rng.multivariate_normal(MEAN, covariance, 2000)
    weights = np.full(2000, 1.0 / 2000)
    paths = [p for p in primitives(1.5) if p.length > 1.4][::5]
    drawn = expected_gain(still, particles, weights, paths, rng, samples=2000, scans=200)
    fine = np.diag(FINEST**2)
    after = np.array([expected_covariance(MEAN, covariance, path, exact) for path in paths])
    closed = gaussian_entropy(covariance + fine, 2) - gaussian_entropy(after + fine, 2)
    assert closed.min() > 0.1
    assert abs(drawn - closed).max() < 0.15


def test_weights_are_those_of_the_sensor_model():
    """With so little noise that what is measured is what is expected: the whitened errors of the model, for each look."""
    seen = forecast_of((4.8, 3.0), (-1.5, 5.5))
    model = replace(seen.model, robust=1e6)
    poses = np.array(((1.0, 2.0, 0.7), (1.1, 1.9, 0.75), (0.8, 2.2, -3.0)))
    out = np.zeros((1, 3), dtype=np.float32)
    stops = np.ones(1, dtype=np.int64)
    replace(seen, model=model, looks_per_metre=1e8).add_log_weights(poses[None], 1.0, stops, np.uint64(0), out)
    ranges, bearings = bearing_range.predict(model, poses[0], seen.world.positions())
    told = bearing_range.log_likelihood(model, poses, seen.world.positions(), ranges, bearings)
    # noise of 1e-4 standard deviations of one sighting times errors of up to 200
    assert out[0] / 1e8 == pytest.approx(told, rel=1e-3, abs=1e-6)


def test_what_is_far_or_behind_a_wall_tells_nothing():
    rng = np.random.default_rng(0)
    particles = rng.multivariate_normal(MEAN, np.diag((0.2**2, 0.2**2, 0.1**2)), 300)
    weights = np.full(300, 1.0 / 300)
    ways = [p for p in primitives(1.5) if p.length > 1.4][:1]

    def gain(*forecasts):
        draws, sensors = np.random.default_rng(1), replace(NOTHING, forecasts=forecasts)
        return expected_gain(sensors, particles, weights, ways, draws, dims=3)[0]

    nothing = gain()
    wall = ((3.6, -10.0, 3.6, 10.0),)
    assert gain(forecast_of((4.8, 3.0))) > nothing + 0.5
    assert gain(forecast_of((4.8, 3.0), walls=wall)) == pytest.approx(nothing)
    assert gain(forecast_of((40.0, 3.0))) == pytest.approx(nothing)
    # to the front alone: this one is on the left
    ahead = replace(forecast_of((0.0, 4.0)), settings=SightingSettings(field_of_view=1.0))
    assert gain(ahead) == pytest.approx(nothing)
    assert gain(forecast_of((0.0, 4.0))) > nothing + 0.5


def test_bearings_wrap():
    """A landmark right behind: bearings to both sides of a half turn are near each other."""
    seen = forecast_of((-2.0, 0.0))
    poses = np.array(((0.0, 0.0, 0.01), (0.0, 0.0, -0.01), (0.0, 0.0, math.pi / 2.0)))
    out = np.zeros((1, 3), dtype=np.float32)
    seen = replace(seen, looks_per_metre=1.0)
    seen.add_log_weights(poses[None], 1.0, np.ones(3, dtype=np.int64), np.uint64(0), out)
    assert out[0, 1] > -10.0 > out[0, 2]
