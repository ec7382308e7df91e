"""Points of a map seen by a camera, in every estimator."""

from dataclasses import replace

import numpy as np
import pytest
from by_hand import made
from camera_world import CAMERA, frame, room, simulate, with_views
from on_a_line import GROWTH, STEP, WHEELS, drive, kalman

from factorgraph_loc import CameraFrame, PixelSightings, PointMap, Rig, Tick, World
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.settings import NOTHING
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.camera.known_points import ITERATIONS, SETTLED, KnownPoints, Predicted
from factors import se2
from factors.camera import model as reprojection
from factors.camera.factor import image_update


@pytest.fixture(scope="module")
def log():
    return simulate(seconds=15.0)


# A camera that looks along y at points 5 m away on a robot that moves along x: u measures x, linearly.
FAR = np.column_stack((np.linspace(-3.0, 3.0, 9), np.full(9, 5.0), np.zeros(9)))
SIGMAS = np.array((0.2, 1e-5, 1e-6))


def side_camera():
    settings = CAMERA.model_copy(
        update={
            "distortion": (0.0, 0.0, 0.0, 0.0),
            "x": 0.0,
            "y": 0.0,
            "z": 0.0,
            "pitch": 0.0,
            "yaw": np.pi / 2,
            "pixel_sigma": 20.0,
            "robust": 100.0,
        }
    )
    return Rig(sensors=("odometry", "sightings"), odometry=WHEELS, camera=settings)


@pytest.mark.parametrize("name", ["ekf", "smoother", "batch", "particle_filter"])
def test_a_linear_gaussian_run_is_that_of_the_kalman_filter_and_smoother(name):
    rig, points = side_camera(), PointMap.of(tuple(f"p{i}" for i in range(9)), FAR)
    model, rng = rig.camera.model(), np.random.default_rng(4)
    many = {"particles": 5000, "smoothing_interval": 0.5, "smoothing_trajectories": 300}
    settings = many if name == "particle_filter" else {}
    estimator = made(name, rig, World(points=points), rig.sensors, 7, **settings)
    x, images = 0.1, []
    for i in range(1, 16):
        x += 0.1 + np.sqrt(0.1 * GROWTH) * rng.standard_normal()
        pixels = reprojection.predict(model, np.array((x, 0.0, 0.0)), FAR)[0]
        pixels += model.sigma * rng.standard_normal(pixels.shape)
        images.append(PixelSightings(STEP * i, points.names, pixels))
    causal = drive(estimator, SIGMAS, 0.1, images)
    places = [np.mean(FAR[:, 0] - (m.pixels[:, 0] - model.cx) * 5.0 / model.fx) for m in images]
    noise = (model.sigma * 5.0 / model.fx) ** 2 / 9.0  # of x from all points
    filtered, smoothed = kalman(places, SIGMAS, 0.1, noise)
    final = estimator.trajectory()
    if name == "particle_filter":
        # the mean of particles of spread s is off by s / sqrt(N_eff): 6 sigma of 500 effective ones, below 1e-7 of false alarms
        assert np.all(np.abs(causal[:, 0] - filtered[:, 0]) < 6.0 * np.sqrt(filtered[:, 1] / 500.0))
        np.testing.assert_allclose(causal[:, 1], filtered[:, 1], rtol=0.25)
        assert np.all(np.abs(final.poses[:, 0] - smoothed[:, 0]) < 6.0 * np.sqrt(smoothed[:, 1] / 80.0))
        return
    if name != "batch":
        np.testing.assert_allclose(causal[:, 0], filtered[:, 0], atol=5e-4)  # a thirtieth of a standard deviation
        np.testing.assert_allclose(causal[:, 1], filtered[:, 1], rtol=1e-2)
    np.testing.assert_allclose(final.poses[:, 0], smoothed[:, 0], atol=5e-4)
    np.testing.assert_allclose(final.covariances[:, 0, 0], smoothed[:, 1], rtol=1e-2)


def test_images_that_are_too_late_are_counted(log):
    estimator = made("ekf", log.rig, log.world, log.rig.sensors)
    estimator.initialize(PosePrior(0.0, np.array((1.0, -1.0, 0.0)), 0.01 * np.eye(3)))
    estimator.process(Tick(3.0))
    estimator.process(PixelSightings(1.0, ("p0", "p1"), np.zeros((2, 2))))
    assert estimator.diagnostics.late == {"camera": 2}


def test_what_is_not_in_the_map_or_of_another_kind_is_counted(log):
    setup = Setup(log.rig, log.world, ("odometry", "sightings"), np.random.default_rng(0))
    diagnostics = Diagnostics()
    points = KnownPoints(setup, diagnostics, NOTHING)
    predicted = Predicted(np.zeros(3), 0.01 * np.eye(3))
    assert points.factor(PixelSightings(0.0, ("nobody", "nothing"), np.zeros((2, 2))), predicted) is None
    assert diagnostics.ignored == {"point not in the map": 2}
    assert points.factor(PixelSightings(0.0, (), np.empty((0, 2))), predicted) is None
    # the map of named points has no views to find features by
    found, _ = frame(with_views(room()), np.zeros(3), 0.0, np.random.default_rng(1))
    assert points.factor(found, predicted) is None
    assert diagnostics.ignored["camera"] == len(found.pixels)
    mapped = World(points=with_views(room()))
    points = KnownPoints(replace(setup, world=mapped, sensors=("odometry", "camera")), diagnostics, NOTHING)
    other = CameraFrame(0.0, "orb", found.pixels, np.zeros((len(found.pixels), 32), np.uint8), found.tracks)
    assert points.factor(other, predicted) is None
    assert diagnostics.ignored["camera: features of another kind than the map's"] == len(found.pixels)


def test_an_update_is_taken_to_the_optimum():
    """From a prediction that is poor, a single step of a Kalman filter would be off by many of its standard deviations."""
    points, model, pose = room(40), CAMERA.model(), np.array((0.5, 0.2, 0.4))
    seen, depth = reprojection.predict(model, pose, points.positions)
    rows = np.flatnonzero(model.contains(seen) & (depth > 0.3))
    setup = Setup(
        Rig(sensors=("sightings",), camera=CAMERA), World(points=points), ("sightings",), np.random.default_rng(0)
    )
    known = KnownPoints(setup, Diagnostics(), NOTHING)
    m = PixelSightings(0.0, tuple(points.names[i] for i in rows), seen[rows])
    start, covariance = se2.compose(pose, np.array((0.3, -0.2, 0.1))), np.diag((0.4, 0.4, 0.2)) ** 2
    factor = known.factor(m, Predicted(start, covariance))
    assert len(factor.points) == len(rows)
    update = image_update(factor, start, covariance, ITERATIONS, SETTLED)
    error = se2.log(se2.between(pose, se2.compose(start, se2.exp(update.delta))))
    assert np.all(np.abs(error) < 0.3 * np.sqrt(np.diag(update.covariance)))
