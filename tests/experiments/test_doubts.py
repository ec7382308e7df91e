"""What a run says of itself where the map and what was measured do not come together."""

from dataclasses import replace

import numpy as np
import pytest
from landmark_world import with_sightings
from picture import SMALL

from factorgraph_loc import CameraFrame, FeatureStream, InputError, PointMap, Rig, SightingStream, Trajectory, World
from factorgraph_loc.evaluation.metrics import FEWEST_SCORED, score
from factorgraph_loc.experiments.doubts import never_localized
from factorgraph_loc.experiments.run import RunConfig, run

NO_POINTS = "straight: the map has no points for the camera: give a map with --world"
STAMPS = np.array([0.3, 0.7])


@pytest.fixture
def blank(log):
    """The short log with a camera whose images show features that no map has, and pixels of an unknown name; no map."""
    nothing = np.zeros((12, 32), dtype=np.uint8)
    frames = [
        CameraFrame(float(t), "orb", np.full((12, 2), 50.0), nothing, np.arange(12) + 12 * i)
        for i, t in enumerate(STAMPS)
    ]
    streams = {
        "odometry": log.streams["odometry"],
        "bearing_range": log.streams["bearing_range"],
        "camera": FeatureStream(STAMPS, frames),
        "sightings": SightingStream(STAMPS, ["x", "x"], np.full(2, 50.0), np.full(2, 60.0)),
    }
    rig = Rig(sensors=("odometry", "camera"), bearing_range=log.rig.bearing_range, camera=SMALL)
    return replace(log, rig=rig, world=World(), streams=streams)


def with_points(log, views):
    """The log in a map of one point, with so many views of it."""
    points = replace(
        PointMap.of(["a"], np.array([[5.0, 0.0, 0.3]])),
        feature="orb" if views else "",
        owners=np.zeros(views, dtype=np.int64),
        descriptors=np.full((views, 32), 255, dtype=np.uint8),
        seen_from=np.zeros((views, 3)),
    )
    return replace(log, world=log.world.model_copy(update={"points": points}))


@pytest.mark.parametrize("sensor", ["camera", "sightings"])
@pytest.mark.parametrize(
    ("name", "settings", "hint"),
    [
        ("ekf", {}, ""),
        ("particle_filter", {"particles": 50}, ""),
        ("smoother", {"landmarks": "known"}, ", or smoother.landmarks=unknown"),
    ],
)
def test_a_camera_in_a_map_without_points(blank, sensor, name, settings, hint):
    result = run(blank, RunConfig(name, settings, ("odometry", sensor)))
    assert [*map(str, result.warnings)] == [NO_POINTS + hint]
    assert sum(result.diagnostics.ignored.values()) == (24 if sensor == "camera" else 2)


@pytest.mark.parametrize("sensor", ["camera", "sightings"])
@pytest.mark.parametrize("name", ["smoother", "batch", "monoslam"])
def test_images_and_wheels_alone_make_a_map_by_themselves(blank, name, sensor):
    result = run(blank, RunConfig(name, sensors=("odometry", sensor)))
    told = f"straight: the map has no points for the camera: points are estimated ({name}.landmarks=unknown)"
    assert [*map(str, result.warnings)] == [told]
    assert result.config["settings"]["landmarks"] == "unknown"
    # not beside what may be in the map, nor where the map has points
    beside = run(blank, RunConfig(name, sensors=("odometry", "bearing_range", sensor)))
    assert beside.config["settings"]["landmarks"] == "known"
    named = run(with_points(blank, 2), RunConfig(name, sensors=("odometry", sensor)))
    assert named.config["settings"]["landmarks"] == "known"


def test_why_a_start_stayed_unknown_is_told_by_the_sensors_that_were_used(blank, log):
    def why(log, *sensors):
        result = run(log, RunConfig("smoother", sensors=("odometry", *sensors), prior="unknown"))
        return result.warnings[-1].fields["why"]

    assert why(with_points(blank, 2), "camera") == "no points of the map were detected"
    assert why(with_points(blank, 2), "bearing_range", "camera") == "no points of the map were detected"
    assert why(blank, "bearing_range") == "the map has nothing that its sensors can detect"
    both = with_points(replace(blank, world=log.world), 2)
    assert why(both, "camera") == "no points of the map were detected"
    unseen = replace(log.streams["bearing_range"], landmark=["x", "y"] * 4)
    both = replace(both, streams=dict(both.streams) | {"bearing_range": unseen})
    assert why(both, "bearing_range") == "no landmarks of the map were detected"
    assert why(both, "bearing_range", "camera") == "its landmarks and points did not determine the pose"


NOTHING = np.full(8, np.nan)


@pytest.mark.parametrize("lacks", ["bearing", "range"])
def test_landmarks_that_no_sighting_can_place_are_not_estimated_by_a_filter(log, lacks):
    alone = with_sightings(log, **{lacks: NOTHING})
    with pytest.raises(InputError, match=f"ekf.landmarks is unknown, but no sighting has a {lacks}"):
        run(alone, RunConfig("ekf", {"landmarks": "unknown"}))
    with pytest.raises(InputError, match=r"ekf\.landmarks is extended"):
        run(replace(alone, world=World()), RunConfig("ekf", {"landmarks": "extended"}))


def with_reference(log, t):
    return replace(log, reference=Trajectory(t, log.reference.at(t)))


def test_fewer_poses_than_tell_anything_are_warned_of(log):
    sparse = with_reference(log, np.arange(0.0, 2.0, 0.4))
    result = run(sparse, RunConfig("dead_reckoning", prior="0,0,0"))
    (warning,) = result.warnings
    assert (warning.kind, warning.fields["poses"], warning.fields["least"]) == ("few_scored", 5, FEWEST_SCORED)
    scores = score(result, sparse)
    assert scores["causal.position_rmse"] is None
    assert scores["causal.scored"] == 5


def test_a_reference_shorter_than_the_log_is_scored_where_it_is(log):
    short = with_reference(log, log.reference.t[(log.reference.t > 0.48) & (log.reference.t < 1.52)])
    result = run(short, RunConfig("dead_reckoning", prior="0,0,0"))
    (warning,) = result.warnings
    assert str(warning) == "straight: scored over 1.0 s of 2.0 s: the reference covers 0.5 s to 1.5 s"
    assert score(result, short)["causal.scored"] == 11


@pytest.mark.parametrize(
    ("status", "why"),
    [("unlocalized", "the log has no positions"), ("ambiguous", "its positions match several poses")],
)
def test_a_robot_without_positions_is_never_localized(log, status, why):
    nothing = Trajectory(np.zeros(0), np.zeros((0, 3)))
    (warning,) = never_localized(replace(log, world=World()), ("odometry", "position"), (status,), nothing)
    assert str(warning) == f"straight: never localized: {why}"
