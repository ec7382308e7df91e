"""A second camera on a robot on the floor, which has a mounting of its own."""

from dataclasses import replace

import numpy as np
import pytest
from camera_world import CAMERA, sightings, simulate, weave

from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.sensors.camera.settings import CameraUncertainty
from factorgraph_loc.sensors.camera.stream import RightSightingStream, SightingStream

BOTH = ("odometry", "sightings", "sightings_right")
CONFIGS = {name: RunConfig(name) for name in ("ekf", "smoother", "batch")}
CONFIGS["particle_filter"] = RunConfig("particle_filter", {"particles": 1000})


@pytest.fixture(scope="module")
def log():
    """A room, seen by a camera ahead and by one 0.4 m to the right of it that looks to the left."""
    log, camera = simulate(seconds=10.0, speeds=weave), CAMERA.model_copy(update={"y": -0.4, "yaw": 0.8})
    t = np.arange(0.13, log.reference.t[-1], 0.2)
    seen = sightings(log.reference, log.world.points, t, np.random.default_rng(7), camera)
    rig = log.rig.model_copy(update={"camera_right": camera, "sensors": BOTH})
    right = RightSightingStream(seen.t, seen.point, seen.u, seen.v)
    return replace(log, rig=rig, streams={**log.streams, "sightings_right": right})


@pytest.mark.parametrize("name", CONFIGS)
def test_both_cameras_are_better_than_one(log, name):
    one, two = (run(log, replace(CONFIGS[name], sensors=sensors)) for sensors in (BOTH[:2], BOTH))
    assert two.diagnostics.rejected == {}
    assert 0.8 < score(two, log)["nis.camera.mean_per_dof"] < 1.2
    before, after = (score(result, log)["final.position_rmse"] for result in (one, two))
    assert after < (1.2 if name == "particle_filter" else 1.0) * before


def test_constants_are_those_of_the_first(log):
    """It is turned by one degree against the rig, the second is not."""
    turned = log.rig.camera.model_copy(
        update={"yaw": log.rig.camera.yaw + np.radians(1.0), "uncertainty": CameraUncertainty(yaw=0.02)}
    )
    result = run(replace(log, rig=log.rig.model_copy(update={"camera": turned})), CONFIGS["smoother"])
    value, sigma = result.learnt.values["camera.yaw"]
    assert value == pytest.approx(-np.radians(1.0), abs=4.0 * sigma)
    assert 0.8 < score(result, log)["nis.camera.mean_per_dof"] < 1.2


@pytest.mark.parametrize("name", ["ekf", "smoother"])
def test_the_second_finds_a_robot_that_does_not_know_its_place(log, name):
    first, late = log.streams["sightings"], log.streams["sightings"].t > 8.0
    rows = SightingStream(*(np.asarray(column)[late] for column in (first.t, first.point, first.u, first.v)))
    result = run(replace(log, streams={**log.streams, "sightings": rows}), replace(CONFIGS[name], prior="unknown"))
    assert score(result, log)["time_to_localized"] < 1.0
    assert score(result, log)["final.position_rmse"] < 0.03
