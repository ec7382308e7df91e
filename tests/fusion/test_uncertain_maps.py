"""Landmarks, tags, points and markers whose places were surveyed with an error: it is the same at each look."""

from dataclasses import replace

import camera_world
import numpy as np
import pytest
from by_hand import made
from drives import even_noise
from scipy.stats import chi2

from factorgraph_loc import BearingRange, Localizer, PixelSightings, Rig, VelocityOdometry, World
from factorgraph_loc.fusion.ekf import MOST
from factorgraph_loc.maps.markers import Marker, corner_names, corner_points
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factorgraph_loc.sensors.odometry.settings import OdometrySettings
from factorgraph_loc.sensors.rfid.known_tags import trust
from factors.camera.model import predict

RIG = Rig(
    sensors=("odometry", "bearing_range"),
    odometry=OdometrySettings(noise=even_noise(per_time=1e-4)),
    bearing_range=BearingRangeSettings(range_sigma=0.05, bearing_sigma=0.02, robust=100.0),
)
MARK, PRIOR = np.array((4.0, 1.0)), np.array((1.0, 1.0, 0.05))
LOOKS, SEEDS = 20, 20


def world(sigma):
    return World(landmarks={"a": {"x": MARK[0], "y": MARK[1], "sigma": sigma}})


def looked(estimator, sigma, seed, settings=None):
    """An estimate after so many looks at one landmark from one place, and its true pose."""
    rng = np.random.default_rng(seed)
    mark = MARK + sigma * rng.standard_normal(2)
    pose = PRIOR * rng.standard_normal(3)
    localizer = Localizer(RIG, world(sigma), estimator=estimator, settings=settings)
    localizer.initialize((0.0, 0.0, 0.0), np.diag(PRIOR**2), t=0.0)
    for k in range(1, LOOKS + 1):
        localizer.push(VelocityOdometry(0.5 * k - 0.25, 0.0, 0.0))
        away = mark - pose[:2]
        seen = np.hypot(*away) + 0.05 * rng.standard_normal()
        bearing = np.arctan2(away[1], away[0]) - pose[2] + 0.02 * rng.standard_normal()
        localizer.push(BearingRange(0.5 * k, ("a",), np.array([seen]), np.array([bearing])))
    return localizer, pose


def nees(estimator, sigma, settings=None, seeds=SEEDS):
    values = []
    for seed in range(seeds):
        localizer, pose = looked(estimator, sigma, seed, settings)
        found = localizer.estimate(0.5 * LOOKS)
        error = found.pose[:2] - pose[:2]
        values.append(float(error @ np.linalg.solve(found.covariance[:2, :2], error)))
    return float(np.mean(values))


@pytest.mark.parametrize(("estimator", "settings"), [("ekf", {}), ("smoother", {}), ("smoother", {"lag": 5.0})])
def test_many_looks_do_not_make_a_poor_survey_better(estimator, settings):
    """The mean of 20 chi-squares of two degrees of freedom, within what it is in all but 1 of 10,000 cases."""
    low, high = chi2.ppf((5e-5, 1.0 - 5e-5), 2 * SEEDS) / SEEDS
    assert low < nees(estimator, 0.3, settings) < high


def test_particles_carry_the_landmark():
    assert 0.8 < nees("particle_filter", 0.3, {"particles": 3000}, seeds=12) < 5.0


def test_the_survey_is_what_is_learnt_of_a_landmark():
    localizer, _ = looked("ekf", 0.3, 1)
    learnt = localizer.learnt().landmarks["a"]
    assert np.linalg.norm(learnt.position - MARK) < 1.5
    # the looks alone tell nothing of where it is in the world but by way of the pose
    assert 0.1 < np.sqrt(learnt.covariance[0, 0]) < 0.31


@pytest.mark.parametrize("estimator", ["ekf", "smoother"])
def test_a_survey_that_is_much_better_than_the_sensor_is_exact(estimator):
    localizer, _ = looked(estimator, 0.009, 2)
    assert localizer.learnt().landmarks == {}
    exact, _ = looked(estimator, 0.0, 2)
    assert np.allclose(localizer.estimate(12.0).covariance, exact.estimate(12.0).covariance, rtol=0.2)


MARKER = Marker(x=3.0, y=0.2, z=0.9, size=0.3, facing=np.pi, sigma=0.05)
NAMES = tuple(corner_names("tag36h11-7"))


def looked_at_a_marker(estimator, seed, settings=None):
    """The squared error in two degrees of freedom after so many images of one marker from one place."""
    rng = np.random.default_rng(seed)
    rig = Rig(sensors=("odometry", "sightings"), odometry=RIG.odometry, camera=camera_world.CAMERA)
    corners, sigmas = MARKER.corners() + MARKER.sigma * rng.standard_normal(3), np.array((0.2, 0.2, 0.03))
    pose = sigmas * rng.standard_normal(3)
    localizer = Localizer(
        rig, World(points=corner_points({"tag36h11-7": MARKER})), estimator=estimator, settings=settings
    )
    localizer.initialize((0.0, 0.0, 0.0), np.diag(sigmas**2), t=0.0)
    for k in range(1, LOOKS + 1):
        localizer.push(VelocityOdometry(0.5 * k - 0.25, 0.0, 0.0))
        pixels = predict(camera_world.CAMERA.model(), pose, corners)[0] + rng.standard_normal((4, 2))
        localizer.push(PixelSightings(0.5 * k, NAMES, pixels))
    found = localizer.estimate(0.5 * LOOKS)
    error = found.pose[:2] - pose[:2]
    return float(error @ np.linalg.solve(found.covariance[:2, :2], error))


@pytest.mark.parametrize("estimator", ["ekf", "smoother"])
def test_the_corners_of_a_marker_have_the_error_of_its_survey_in_common(estimator):
    """Within what the mean of 20 such chi-squares is in all but 1 of 10,000 cases."""
    low, high = chi2.ppf((5e-5, 1.0 - 5e-5), 2 * SEEDS) / SEEDS
    assert low < np.mean([looked_at_a_marker(estimator, seed) for seed in range(SEEDS)]) < high


def test_particles_count_the_looks_at_a_marker():
    assert 0.2 < np.mean([looked_at_a_marker("particle_filter", seed, {"particles": 3000}) for seed in range(12)]) < 5.0


def test_a_state_of_many_points_is_bounded():
    points = camera_world.room(160, 1)
    spread = np.broadcast_to(0.05**2 * np.eye(3), (len(points), 3, 3))
    log = camera_world.simulate(1, 12.0, rate=2.0, points=points, limit=60)
    sensors = ("odometry", "sightings")
    ekf = made("ekf", log.rig, World(points=replace(points, covariances=spread)), sensors)
    ekf.initialize(PosePrior(0.0, log.reference.poses[0], 0.01 * np.eye(3)))
    for m in log.measurements(sensors):
        ekf.process(m)
    assert MOST <= len(ekf._state.covariance) < MOST + 3


def test_tags_are_trusted_by_their_survey():
    assert trust(np.zeros(3)) == 1.0
    assert trust(np.full(3, 0.019)) == 1.0
    assert trust(np.full(3, 0.1)) == pytest.approx(0.5)
    assert trust(np.array((0.0, 0.1))) == pytest.approx(0.75)
