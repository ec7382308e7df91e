"""What a way would show, and how much it would tell: scans, landmarks and the covariance at its end."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numerical import by_pose as numerical

from factorgraph_loc import Landmark, Rig, Tag, World
from factorgraph_loc.planning import particle_kernels
from factorgraph_loc.planning.information import (
    FINEST,
    METRES_PER_RADIAN,
    SPEED,
    Sensors,
    expected_covariance,
    expected_gain,
    fisher_gain,
    gaussian_entropy,
)
from factorgraph_loc.planning.paths import Path, primitives
from factorgraph_loc.sensors.landmarks.measurement import SightingSettings
from factorgraph_loc.sensors.landmarks.simulation import LandmarkForecast
from factorgraph_loc.sensors.rfid import forecast as expected_scans
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation.settings import RACKHAM_RIG
from factors import se2
from factors.landmarks import model as bearing_range
from factors.motion import ChainState
from factors.odometry.model import Growth, OdometryModel, relative_motion
from factors.rfid.detection import RfidLikelihood, TagArray
from factors.rfid.model import Antenna, BeamModel, LogisticModel, RfidModel, bake

ANTENNAS = tuple(Antenna(0.2 * math.cos(a), 0.2 * math.sin(a), 1.2, a) for a in (0.0, 1.6, -2.0))
FACING_MODEL = LogisticModel((2.0, -0.9, -0.05, -3.0, 0.2, 0.1, -0.4, 1.0, 0.2, 0.0, 0.0))


def likelihood(model=None, tempering=1.0, facing=np.nan):
    model = RfidModel(ANTENNAS, (model or BeamModel(),), 1e-3, 0.02, tempering)
    points = np.array(((3.0, 1.0, 1.0), (1.5, -2.0, 1.0), (-2.0, 1.0, 1.5), (30.0, 0.0, 1.0)))
    return RfidLikelihood(model, TagArray(points, np.full(4, facing)))


def weighed(found, poses, rounds, stops, scans, seeds):
    """Log-weights (R, J, M) of R sets of scans."""
    tables = expected_scans.make_tables(found)
    out = np.empty((len(seeds), scans, poses.shape[1]), np.float32)
    for each, seed in zip(out, seeds, strict=True):
        arguments = (np.array(rounds), np.array(stops), scans, np.uint64(seed), found.model.tempering)
        expected_scans.log_weights(tables, poses, *arguments, each)
    return out


def divergence(found, a, b, rounds):
    """Kullback-Leibler divergence of the scans at poses ``b`` (S, 3) from those at ``a``, and the variance of what it is the mean
    of; tags beyond the reach of all are left out."""
    mean = variance = 0.0
    for k, count in enumerate(rounds):
        for antenna in range(len(found.model.antennas)):
            p, q = (found.probabilities(x[k : k + 1], antenna)[0, :3] for x in (a, b))
            yes, no = np.log(p / q), np.log((1.0 - p) / (1.0 - q))
            mean += count * np.sum(p * yes + (1.0 - p) * no)
            variance += count * np.sum(p * (1.0 - p) * (yes - no) ** 2)
    return mean, variance


@pytest.mark.parametrize(
    ("model", "facing"),
    [(BeamModel(), np.nan), (bake(BeamModel(), 6.0), np.nan), (FACING_MODEL, 2.0), (FACING_MODEL, np.nan)],
)
def test_log_weights_differ_in_the_mean_by_the_divergence(model, facing):
    """Draws and weights together: the mean over scans of log p(z|a) - log p(z|b) is a divergence that the exact model tells. Five
    standard deviations of that mean are allowed (one false alarm in 10^6), and 10 % for the cells of the tables."""
    found = likelihood(model, facing=facing)
    poses = np.array([[(0.0, 0.0, 0.1), (0.4, -0.3, 0.5)], [(1.0, 0.2, 0.1), (1.2, 0.3, 0.6)]])
    rounds = (4, 7)
    got = weighed(found, poses, rounds, (2, 2), 2, range(4000))
    for a, b in ((0, 1), (1, 0)):
        mean, variance = divergence(found, poses[:, a], poses[:, b], rounds)
        assert mean > 0.2
        tolerance = 5.0 * math.sqrt(variance / 4000) + 0.1 * mean + 0.02
        assert np.mean(got[:, a, a] - got[:, a, b]) == pytest.approx(mean, abs=tolerance)


def test_tempering_scales_weights_of_the_same_scans():
    poses = np.array([[(0.0, 0.0, 0.1), (0.4, -0.3, 0.5)]])
    whole, half = (weighed(likelihood(tempering=t), poses, (5,), (1, 1), 2, range(20)) for t in (1.0, 0.5))
    np.testing.assert_allclose(half, whole / 2.0, rtol=1e-5)
    assert np.ptp(whole) > 1.0


def test_who_is_stopped_scans_no_more():
    poses = np.array([[(0.0, 0.0, 0.1), (0.4, -0.3, 0.5)], [(1.0, 0.2, 0.1), (1.2, 0.3, 0.6)]])
    found = likelihood()
    none, one, two = (weighed(found, poses, (4, 7), (s, 2), 2, range(5)) for s in (0, 1, 2))
    np.testing.assert_array_equal(none[:, 0], 0.0)
    np.testing.assert_array_equal(one[:, 0], weighed(found, poses[:1], (4,), (1, 1), 2, range(5))[:, 0])
    assert not np.allclose(one[:, 0], two[:, 0])
    np.testing.assert_array_equal(one[:, 1], two[:, 1])


def test_draws_are_uniform_and_rounds_binomial():
    """Kolmogorov's bound at a false-alarm rate of 10^-6."""
    u = np.sort([expected_scans._uniform(np.uint64(7), n) for n in range(20_000)])
    assert abs(u - (np.arange(20_000) + 0.5) / 20_000).max() < 2.7 / math.sqrt(20_000)
    n, q = 6, 0.3
    found = [expected_scans._binomial(n, q, x) for x in u.tolist()]
    counts = np.bincount([k for k, _ in found], minlength=n + 1) / len(u)
    expected = [math.comb(n, k) * q**k * (1.0 - q) ** (n - k) for k in range(n + 1)]
    np.testing.assert_allclose(counts, expected, atol=0.005)
    # what is left of a draw is uniform once more, whatever it gave
    for k in range(4):
        left = np.sort([rest for got, rest in found if got == k])
        even = (np.arange(len(left)) + 0.5) / len(left)
        assert abs(left - even).max() < 2.7 / math.sqrt(len(left))


def stations(noise=0.0, seed=0):
    along = se2.exp(np.column_stack((0.25 * np.arange(21), np.zeros(21), 0.1 * np.arange(21))))
    steps = np.array((0, 3, 9, 15, 20))
    rng = np.random.default_rng(seed)
    particles = np.column_stack((rng.normal(size=(4000, 2)), rng.uniform(-3.0, 3.0, 4000)))
    sigmas = noise * np.array(((0.0, 0.0, 0.0), *[(0.02, 0.01, 0.03)] * 4))
    return along, steps, particles, sigmas, rng.standard_normal((5, 4000, 3))


def test_particles_follow_the_path_until_they_are_stopped():
    along, steps, particles, sigmas, normals = stations()
    last = np.arange(4000) % 25
    out = np.empty((5, 4000, 3))
    particle_kernels.station_poses(particles, along, steps, last, sigmas, normals, out)
    for k, step in enumerate(steps.tolist()):
        expected = se2.compose(particles, along[np.minimum(step, last)])
        np.testing.assert_allclose(out[k, :, :2], expected[:, :2], atol=1e-9)
        np.testing.assert_allclose(se2.wrap(out[k, :, 2] - expected[:, 2]), 0.0, atol=1e-9)


def test_noise_on_the_way_adds_up_as_small_motions_do():
    """Against exact composition, draw by draw, and the standard deviations of 4000 draws to 6 % (5 of their own)."""
    along, steps, particles, sigmas, normals = stations(noise=1.0)
    out = np.empty((5, 4000, 3))
    particle_kernels.station_poses(particles, along, steps, np.full(4000, 99), sigmas, normals, out)
    exact = particles
    for k in range(1, 5):
        exact = se2.compose(exact, se2.between(along[steps[k - 1]], along[steps[k]]))
        exact = se2.compose(exact, se2.exp(sigmas[k] * normals[k]))
        error = se2.between(exact, out[k])
        assert abs(error).max() < 0.03  # second order in the noise
    spread = se2.log(se2.between(se2.compose(particles, along[-1]), out[-1])).std(axis=0)
    assert spread[2] == pytest.approx(0.06, rel=0.06)
    assert spread[1] > 0.06


RIG = Rig.model_validate(RACKHAM_RIG)
MEAN = np.array((1.0, 2.0, 0.7))


def sensors_of(world):
    settings, turn_rate = preset("office"), SPEED / METRES_PER_RADIAN
    return Sensors.of(world, RIG, settings, SPEED, turn_rate, ("rfid", "landmarks"))


NOTHING = sensors_of(World())


def forecast_of(*points, walls=()):
    world = World(landmarks={f"L{i}": Landmark(x=x, y=y) for i, (x, y) in enumerate(points)}, walls=walls)
    (only,) = sensors_of(world).forecasts
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
    closed = gaussian_entropy(covariance + fine) - gaussian_entropy(after + fine)
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
        return expected_gain(sensors, particles, weights, ways, draws)[0]

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


NOISE = OdometryModel(along=Growth(0.02), lateral=Growth(0.01), heading=Growth(0.03))
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


def test_it_agrees_with_the_monte_carlo_gain_where_the_belief_is_narrow():
    """As narrow as the sensors are nearly linear, with tags at the end of their reach. What the Monte-Carlo gain does not count, as
    too fine, is added to the closed covariances too. The order of the paths is the same."""
    world, paths = tagged((4.8, 3.0), (-1.5, 5.5)), [p for p in primitives(1.5) if p.length > 1.4][::5]
    sensors = replace(sensors_of(world), odometry=NOISE)
    covariance = np.diag((0.3**2, 0.3**2, 0.15**2))
    rng = np.random.default_rng(0)
    particles = rng.multivariate_normal(MEAN, covariance, 2000)
    weights = np.full(2000, 1.0 / 2000)
    drawn = expected_gain(sensors, particles, weights, paths, rng, noise=NOISE, samples=2000, scans=200)
    fine = np.diag(FINEST**2)
    after = np.array([expected_covariance(MEAN, covariance, path, sensors) for path in paths])
    closed = gaussian_entropy(covariance + fine) - gaussian_entropy(after + fine)
    assert abs(drawn - closed).max() < 0.2
    assert abs(np.mean(drawn - closed)) < 0.1
    assert np.corrcoef(drawn, closed)[0, 1] > 0.9
    assert np.ptp(closed) > 0.3


def test_the_gain_is_the_fall_of_entropy():
    sensors = sensors_of(tagged((4.8, 3.0), (-1.5, 5.5)))
    (gain,) = fisher_gain(MEAN, COVARIANCE, [STRAIGHT], sensors)
    after = expected_covariance(MEAN, COVARIANCE, STRAIGHT, sensors)
    # of what is not finer than counts
    fine = np.diag(FINEST**2)
    before, left = (gaussian_entropy(covariance + fine) for covariance in (COVARIANCE, after))
    assert gain == pytest.approx(before - left)
    assert fisher_gain(MEAN, COVARIANCE, [], sensors).shape == (0,)


def test_only_sensors_that_find_something_are_taken():
    nothing = sensors_of(World())
    assert nothing.forecasts == ()
    (gain,) = fisher_gain(MEAN, COVARIANCE, [STRAIGHT], nothing)
    assert gain < 0.0
    assert math.isfinite(gain)
