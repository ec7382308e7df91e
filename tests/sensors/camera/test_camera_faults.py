"""Every estimator on what a camera sees, with what goes wrong."""

from dataclasses import replace

import numpy as np
import pytest
from camera_world import CAMERA, simulate, weave, with_camera, with_sightings

from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import cut
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraUncertainty
from factors import se2

CONFIGS = {
    "ekf": RunConfig("ekf"),
    "particle_filter": RunConfig("particle_filter", {"particles": 500}),
    "smoother": RunConfig("smoother"),
}
CLEAN = 0.02  # m: what the final position error stays below where nothing is wrong


@pytest.fixture(scope="module")
def log():
    return simulate(seconds=20.0, speeds=weave)


def final_rmse(result, log):
    assert np.all(np.isfinite(result.poses))
    assert np.all(np.isfinite(result.covariances))
    return score(result, log)["final.position_rmse"]


def test_an_offset_of_time_is_estimated(log):
    early = with_sightings(log, t=log.streams["sightings"].t - 0.1)
    for name in ("ekf", "smoother"):
        found = run(with_camera(early, uncertainty=CameraUncertainty(time_offset=0.1)), CONFIGS[name])
        offset, sigma = found.learnt.values["camera.time_offset"]
        assert abs(offset - 0.1) < 4.0 * sigma  # below 1e-4 of false alarms
        assert sigma < 0.03
        assert final_rmse(found, log) < 1.5 * CLEAN


@pytest.mark.parametrize("name", CONFIGS)
def test_a_camera_that_was_knocked_does_not_break_a_run(name, log):
    """A pitch that is wrong by 6 degrees: nothing agrees. What is told must be finite, and that it is wrong must show."""
    result = run(with_camera(cut(log, 0.0, 10.0), pitch=CAMERA.pitch + 0.1), CONFIGS[name])
    assert np.all(np.isfinite(result.poses))
    assert np.all(np.isfinite(result.final.poses))
    assert result.diagnostics.rejected["camera: point disagrees with the other points of the image"] > 250


@pytest.mark.parametrize("name", ["ekf", "particle_filter"])
def test_points_behind_the_camera_and_at_its_place_do_no_harm(name, log):
    """Names that the map has behind the robot, and at where the camera is."""
    points = log.world.points
    positions = points.positions.copy()
    poses = log.reference.at(np.linspace(0.0, 20.0, 20))
    ahead = se2.compose(poses, np.array((CAMERA.x, CAMERA.y, 0.0)))
    positions[:20] = np.column_stack((ahead[:, :2], np.full(20, CAMERA.z)))
    positions[20:30] *= -1.0
    result = run(replace(log, world=World(points=replace(points, positions=positions))), CONFIGS[name])
    assert final_rmse(result, log) < CLEAN
