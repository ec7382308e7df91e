"""Points of a map seen by a camera, in every estimator."""

from dataclasses import replace

import numpy as np
import pytest
from by_hand import made
from camera_world import CAMERA, frame, room, simulate, with_views

from factorgraph_loc import CameraFrame, PixelSightings, Rig, Tick, World
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
