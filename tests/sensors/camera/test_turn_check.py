"""A wrong clock and a wrong focal length are told by how images turn, without a map, and wheels are not mistaken for them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from camera_world import CAMERA, RIG, room, sightings, weave, with_sightings
from drives import driven

from factorgraph_loc import Log, Trajectory, VelocityStream, World
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.settings import NOTHING, Estimated
from factorgraph_loc.sensors.camera.use import TurnCheck
from factorgraph_loc.sensors.motion import whole_motion
from factors import se2
from factors.camera.model import FOCAL, PARAMETERS, TIME_OFFSET

STEP, SECONDS = 0.05, 40.0
NOISE = np.array((0.02, 0.03))  # m/s and rad/s, of the wheels' velocities
POINTS = room(500, seed=3)
RIGHT_LENS = CAMERA.model_copy(update={"pixel_sigma": 0.5})
WRONG_LENS = RIGHT_LENS.model_copy(update={"fx": 1.05 * CAMERA.fx, "fy": 1.05 * CAMERA.fy})


@cache
def drive(seed, speeds=weave, seconds=SECONDS):
    """A log of exact poses, noisy wheels, and pixels."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, STEP)
    v, w = speeds(t)
    truth = Trajectory(t, driven(se2.exp(np.column_stack((v, 0.0 * v, w))[:-1] * STEP), (1.0, -1.0, 0.0)))
    seen = sightings(truth, POINTS, np.arange(0.5, seconds - 0.5, 0.2), rng, RIGHT_LENS, limit=60)
    v, w = np.array((v, w)) + NOISE[:, None] * rng.standard_normal((2, len(t)))
    return Log("room", RIG, World(), {"odometry": VelocityStream(t, v, w), "sightings": seen}, truth)


def told(log, camera=RIGHT_LENS, late=0.0, scale=1.0, estimated=NOTHING):
    """The events of a run in which images are stamped ``late`` [s] and the wheels turn by ``scale`` times of what they say."""
    wheels = log.streams["odometry"]
    log = replace(log, streams={**log.streams, "odometry": VelocityStream(wheels.t, wheels.v, wheels.w / scale)})
    diagnostics = Diagnostics()
    check = TurnCheck(camera.model(), whole_motion(log, ("odometry",)), diagnostics, estimated)
    for m in log.streams["sightings"].measurements(late):
        check.add(m)
    assert check.told == bool(diagnostics.events)
    return [what for _, what in diagnostics.events]


@pytest.mark.parametrize(("seed", "scale"), [(0, 1.0), (1, 0.95)])
def test_nothing_is_told_of_a_camera_as_the_rig_says(seed, scale):
    """Two runs, in one of which the wheels are wrong; five standard deviations beyond the tolerance leave less than one
    false alarm in 10,000 runs."""
    assert told(drive(seed), scale=scale) == []


@pytest.mark.parametrize(("seed", "late"), [(0, 0.1), (1, -0.1)])
def test_an_offset_of_the_clock_is_told_once(seed, late):
    (event,) = told(drive(seed), late=late)
    assert f"s {'earlier' if late > 0.0 else 'later'} than they are stamped" in event
    assert float(event.split("taken ")[1].split(" s ")[0]) == pytest.approx(0.1, abs=0.03)


def test_a_wrong_focal_length_is_told_once_whatever_the_wheels_say():
    (event,) = told(drive(1), WRONG_LENS, scale=0.95)
    assert "the focal length seems to be" in event
    assert float(event.split("be ")[1].split(" %")[0]) == pytest.approx(5.0, abs=1.5)
    assert "shorter" in event


def test_what_is_estimated_is_not_told():
    for place, faults in ((FOCAL, {"camera": WRONG_LENS}), (TIME_OFFSET, {"late": 0.1})):
        assert told(drive(1), **faults, estimated=Estimated((PARAMETERS[place],), (place,), np.array((0.1,)))) == []


def test_where_the_robot_hardly_turns_nothing_is_told():
    straight = drive(1, lambda t: (np.full(len(t), 0.05), np.full(len(t), 0.02)))
    assert told(straight, WRONG_LENS, late=0.1) == []


@pytest.mark.parametrize(("estimator", "late"), [("smoother", 0.0), ("smoother", 0.1), ("monoslam", 0.1)])
def test_a_run_without_a_map_doubts_the_model_with_a_wrong_clock(estimator, late):
    log = drive(1, seconds=20.0)
    stamped = with_sightings(log, t=log.streams["sightings"].t + late)
    result = run(stamped, RunConfig(estimator, {"landmarks": "unknown"}))
    assert result.doubts_model[-1] == (late > 0.0)
    assert any("time_offset" in what for _, what in result.diagnostics.events) == (late > 0.0)
