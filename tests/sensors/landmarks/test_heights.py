"""Landmarks above or below their sensor: ranges to them are slant ranges."""

from dataclasses import replace

import numpy as np
import pytest
from numerical import by_pose, derivative

import factorgraph_loc as fgloc
from factorgraph_loc.evaluation.inspect import inspect
from factors.landmarks.factor import BearingRangeFactor
from factors.landmarks.model import BearingRangeModel

CHANGES = {"drive": {"duration": 60.0}, "world": {"tags": 0, "landmarks": 8}, "sightings": {"rate": 10.0}}
SENSORS = ("odometry", "bearing_range")
HEIGHT, Z = 2.8, 0.5  # m, of the landmarks and of the sensor


@pytest.fixture(scope="module")
def flat():
    """A drive among landmarks in the plane of the sensor, with ranges alone."""
    log = fgloc.simulate("office", 4, changes=CHANGES)
    sightings = log.streams["bearing_range"]
    alone = replace(sightings, bearing=np.full_like(sightings.bearing, np.nan))
    return replace(log, streams=log.streams | {"bearing_range": alone})


@pytest.fixture(scope="module")
def tall(flat):
    """The same drive with the landmarks at the ceiling, as a map says and as one without heights has it."""
    sightings, reference, settings = flat.streams["bearing_range"], flat.reference, flat.rig.bearing_range
    rig = flat.rig.model_copy(update={"bearing_range": settings.model_copy(update={"z": Z})})
    marks = {name: mark.model_copy(update={"z": HEIGHT}) for name, mark in flat.world.landmarks.items()}
    world = flat.world.model_copy(update={"landmarks": marks})
    places = np.array([(marks[name].x, marks[name].y) for name in sightings.landmark])
    exact = np.hypot(*(reference.at(sightings.t)[:, :2] - places).T)
    error = sightings.range - exact  # the sensor is at the robot's origin
    slant = replace(sightings, range=np.hypot(exact, HEIGHT - Z) + error)
    return replace(flat, rig=rig, world=world, streams=flat.streams | {"bearing_range": slant})


@pytest.mark.parametrize("estimator", ["ekf", "particle_filter", "smoother"])
def test_landmarks_at_the_ceiling_are_as_good_as_others(flat, tall, estimator):
    """Near a landmark slant ranges determine the position less; without heights the error is ten times as large."""
    at_height, in_plane = (fgloc.run(log, estimator, sensors=SENSORS).scores for log in (tall, flat))
    assert at_height["final.position_rmse"] < 1.6 * in_plane["final.position_rmse"]
    assert at_height["causal.anees"] < 5.0


@pytest.mark.parametrize("estimator", ["ekf", "particle_filter", "smoother"])
def test_an_inexact_survey_keeps_the_heights(tall, estimator):
    """Without its height a landmark that is estimated from its survey would contradict each slant range."""
    marks = {name: mark.model_copy(update={"sigma": 0.1}) for name, mark in tall.world.landmarks.items()}
    inexact = replace(tall, world=tall.world.model_copy(update={"landmarks": marks}))
    surveyed, exact = (fgloc.run(log, estimator, sensors=SENSORS).scores for log in (inexact, tall))
    assert surveyed["causal.position_rmse"] < 1.3 * exact["causal.position_rmse"]
    assert surveyed["causal.anees"] < 5.0


def test_an_unknown_start_among_landmarks_at_the_ceiling(flat, tall):
    at_height, in_plane = (fgloc.run(log, "smoother", sensors=SENSORS, prior="unknown").scores for log in (tall, flat))
    assert at_height["final.position_rmse"] < 1.6 * in_plane["final.position_rmse"]


def made_map(log, tmp_path):
    """The landmarks of the map that is made from a log."""
    fgloc.build_map(log, tmp_path / "made.world.toml")
    return fgloc.read_world(tmp_path / "made.world.toml").landmarks


def test_a_map_is_made_with_given_heights(tall, tmp_path):
    """Where the given map has the heights, learnt positions agree with it, and the heights stay."""
    bearings = fgloc.simulate("office", 4, changes=CHANGES).streams["bearing_range"].bearing
    sightings = replace(tall.streams["bearing_range"], bearing=bearings)
    given = tall.world.landmarks
    made = made_map(replace(tall, streams=tall.streams | {"bearing_range": sightings}), tmp_path)
    assert len(made) >= 3
    assert {mark.z for mark in made.values()} == {HEIGHT}
    assert np.median([np.hypot(mark.x - given[name].x, mark.y - given[name].y) for name, mark in made.items()]) < 0.2


def test_a_new_landmark_is_level_with_the_sensor(flat, tall, tmp_path):
    alone = replace(flat, rig=tall.rig, world=flat.world.model_copy(update={"landmarks": {}}))
    assert {mark.z for mark in made_map(alone, tmp_path).values()} == {Z}


def test_new_landmarks_get_the_given_height(tall, tmp_path):
    bearings = fgloc.simulate("office", 4, changes=CHANGES).streams["bearing_range"].bearing
    sightings = replace(tall.streams["bearing_range"], bearing=bearings)
    world = tall.world.model_copy(update={"landmarks": {}})
    unknown = replace(tall, world=world, streams=tall.streams | {"bearing_range": sightings})
    fgloc.build_map(unknown, tmp_path / "made.world.toml", height=HEIGHT)
    made, true = fgloc.read_world(tmp_path / "made.world.toml").landmarks, tall.world.landmarks
    assert {mark.z for mark in made.values()} == {HEIGHT}
    errors = [np.hypot(mark.x - true[name].x, mark.y - true[name].y) for name, mark in made.items()]
    assert np.median(errors) < 0.3
    with pytest.raises(fgloc.InputError, match="state z of the landmarks"):
        fgloc.build_map(tall, tmp_path / "other.world.toml", height=HEIGHT, extend=True)


def test_a_map_without_heights_is_doubted(tall):
    marks = {name: mark.model_copy(update={"z": Z}) for name, mark in tall.world.landmarks.items()}
    without = replace(tall, world=tall.world.model_copy(update={"landmarks": marks}))
    (problem,) = [problem for problem in inspect(without).problems if problem.kind == "height"]
    assert problem.fields["height"] == pytest.approx(HEIGHT - Z, abs=0.2)
    assert "height" not in [problem.kind for problem in inspect(tall).problems]


@pytest.mark.parametrize("kind", ["range", "both"])
def test_derivatives_with_a_height(kind):
    model = BearingRangeModel(mounting=(0.2, -0.1, 0.3), range_scale=1.1, range_sigma=0.1, bearing_sigma=0.05)
    points = np.array(((3.0, 1.0, 2.3), (0.3, 0.2, -1.0)))
    bearings = np.array((0.2, 0.4)) if kind == "both" else np.full(2, np.nan)
    factor = BearingRangeFactor(model, points, np.array((4.0, 1.0)), bearings, estimated=(0, 1, 2, 3))
    pose, none = np.array((0.5, -0.4, 0.6)), np.zeros(4)
    residual, (by_poses, by_constants) = factor.whitened([pose, none])
    np.testing.assert_allclose(by_poses, by_pose(lambda at: factor.whitened([at, none])[0], pose), atol=1e-6)
    np.testing.assert_allclose(by_constants, derivative(lambda d: factor.whitened([pose, d])[0], 4), atol=1e-6)
    free = replace(factor, points=points[:1], ranges=np.array((4.0,)), bearings=bearings[:1], estimated=(), free=True)
    at = points[0, :2]
    by_point = free.whitened([pose, at])[1][-1]
    np.testing.assert_allclose(by_point, derivative(lambda d: free.whitened([pose, at + d])[0], 2), atol=1e-6)
    np.testing.assert_allclose(free.whitened([pose, at])[0], residual[:1])


def test_a_table_of_anchors_with_heights(tmp_path):
    (tmp_path / "anchors.csv").write_text("id,x,y,z\n0x6743,0.0,10.0,1.5\n0x675b,10.0,10.0,1.6\n")
    columns = '{ landmark = "id", x = "x", y = "y", z = "z" }'
    (tmp_path / "hall.world.toml").write_text(f'[landmarks]\nfile = "anchors.csv"\ncolumns = {columns}\n')
    assert [mark.z for mark in fgloc.read_world(tmp_path / "hall.world.toml").landmarks.values()] == [1.5, 1.6]
