"""Landmarks that are estimated from ranges alone, or from bearings alone."""

from dataclasses import replace

import numpy as np
import pytest
from changed_logs import with_rig, with_stream
from landmark_world import simulate

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.maps import MapOptions, make_map
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import cut
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeUncertainty

UNKNOWN = RunConfig("smoother", {"landmarks": "unknown"})
NOT_LOCATED = "landmark not located yet"
HIDDEN = {"range": "bearing", "bearing": "range"}


def only(log, kept):
    """The log with ranges alone, or bearings alone."""
    stream = log.streams["bearing_range"]
    return with_stream(log, "bearing_range", **{HIDDEN[kept]: np.full_like(stream.bearing, np.nan)})


@pytest.fixture(scope="module")
def drive():
    log = simulate(seconds=90.0)
    return with_stream(log, "bearing_range", range=np.maximum(log.streams["bearing_range"].range, 0.01))


@pytest.fixture(scope="module")
def ranges(drive):
    return only(drive, "range")


def of(log, *names):
    """The log with sightings of some landmarks only."""
    stream = log.streams["bearing_range"]
    rows = np.isin(stream.landmark, names)
    kept = [name for name in stream.landmark if name in names]
    changed = replace(stream, t=stream.t[rows], landmark=kept, range=stream.range[rows], bearing=stream.bearing[rows])
    return replace(log, streams={**log.streams, "bearing_range": changed})


@pytest.mark.parametrize(("kept", "fewest"), [("range", 8), ("bearing", 4)])
@pytest.mark.parametrize("name", ["smoother", "batch"])
def test_landmarks_are_located(name, kept, fewest, drive):
    log = only(drive, kept)
    result = run(log, replace(UNKNOWN, estimator=name))
    scores = score(result, log)
    assert len(result.learnt.landmarks) >= fewest
    assert scores["landmarks.rmse"] < 0.2
    assert scores["final.aligned_position_rmse"] < 0.2
    assert (NOT_LOCATED in result.diagnostics.ignored) is (len(result.learnt.landmarks) < 8)


def test_outliers_do_not_harm(ranges):
    stream, rng = ranges.streams["bearing_range"], np.random.default_rng(0)
    longer = np.where(rng.random(len(stream.t)) < 0.15, rng.uniform(0.5, 6.0, len(stream.t)), 0.0)
    log = with_stream(ranges, "bearing_range", range=stream.range + longer)
    scores = score(run(log, UNKNOWN), log)
    assert scores["landmarks.rmse"] < 0.2
    assert scores["final.aligned_position_rmse"] < 0.1


def test_a_straight_path_has_two_sides():
    def straight(t):
        return np.full(len(t), 0.3), np.zeros(len(t))

    log = only(simulate(seconds=20.0, speeds=straight), "range")
    result = run(log, UNKNOWN)
    assert not result.learnt.landmarks
    assert result.diagnostics.ignored[NOT_LOCATED] > 50


@pytest.mark.parametrize("kind", ["constant", "random"])
def test_wrong_ranges_are_of_no_landmark(kind, ranges):
    stream = ranges.streams["bearing_range"]
    value = 0.5 if kind == "constant" else np.random.default_rng(0).uniform(0.5, 8.0, len(stream.t))
    same = np.array([name == "h" for name in stream.landmark])
    result = run(with_stream(ranges, "bearing_range", range=np.where(same, value, stream.range)), UNKNOWN)
    assert set(result.learnt.landmarks) == set(stream.landmark) - {"h"}
    assert 0 < result.diagnostics.ignored[NOT_LOCATED] <= np.count_nonzero(same)


def test_one_anchor_and_anchors_on_a_line(ranges):
    for names in (["h"], ["a", "b", "c"]):
        log = of(ranges, *names)
        result = run(log, UNKNOWN)
        assert set(result.learnt.landmarks) == set(names)
        assert (
            score(result, log)["final.position_rmse"]
            < score(run(log, RunConfig("dead_reckoning")), log)["final.position_rmse"]
        )


def test_what_a_map_lacks_is_added(ranges):
    part = World(landmarks={name: ranges.world.landmarks[name] for name in "aceg"})
    result = run(replace(ranges, world=part), RunConfig("smoother", {"landmarks": "extended"}))
    assert set(result.learnt.landmarks) == set("bdfh")
    for name, learnt in result.learnt.landmarks.items():
        error = learnt.position - ranges.world.position(name)
        assert error @ np.linalg.solve(learnt.covariance, error) < 20.0


def test_a_short_window_keeps_what_it_located(ranges):
    result = run(ranges, RunConfig("smoother", {"landmarks": "unknown", "lag": 5.0}))
    assert set(result.learnt.landmarks) == set(ranges.streams["bearing_range"].landmark)


def test_estimates_are_causal(ranges):
    """What comes later does not change an estimate, nor does asking for the trajectory."""
    whole, part = run(ranges, UNKNOWN), run(cut_at(ranges, 60.0), UNKNOWN)
    count = len(part.t)
    np.testing.assert_array_equal(whole.poses[:count], part.poses)


def cut_at(log, t):
    return replace(cut(log, log.span()[0], t), start=log.start)


def test_the_map_of_one_drive_serves_another(ranges):
    made = make_map(replace(ranges, world=World()), MapOptions(of="landmarks"))
    assert all(landmark.covariance is not None for landmark in made.world.landmarks.values())
    log = replace(only(simulate(seed=2, seconds=60.0), "range"), world=made.world)
    scores = score(
        run(log, RunConfig("smoother")), log, "se2"
    )  # the frame of the map is that of the first drive's start
    assert scores["final.aligned_position_rmse"] < 0.1


BIASES = {"a": 0.6, "b": -0.5, "c": 0.1, "d": -0.2, "e": -0.1, "f": 0.0, "g": -0.6, "h": 0.2}


@pytest.mark.parametrize(("name", "landmarks"), [("smoother", "known"), ("smoother", "unknown"), ("ekf", "known")])
def test_biases_and_scale_of_ranges_are_learnt(name, landmarks, ranges):
    stream = ranges.streams["bearing_range"]
    wrong = 1.05 * stream.range + [BIASES[mark] for mark in stream.landmark]
    uncertain = BearingRangeUncertainty(range_bias=0.3, range_scale=0.1)
    log = with_stream(ranges, "bearing_range", range=np.maximum(wrong, 0.01))
    log = with_rig(log, "bearing_range", uncertainty=uncertain)
    result = run(log, RunConfig(name, {"landmarks": landmarks}))
    scores, values = score(result, log), result.learnt.values
    assert scores["final.position_rmse" if landmarks == "known" else "final.aligned_position_rmse"] < 0.08
    assert values["bearing_range.range_scale"][0] == pytest.approx(0.05, abs=0.03)
    for mark in {"a", "e", "g"} & (result.learnt.landmarks or log.world.landmarks).keys():
        value, sigma = values[f"bearing_range.{mark}.bias"]
        assert value == pytest.approx(BIASES[mark], abs=4.0 * sigma)
        assert sigma < 0.2


def test_the_ekf_needs_both(ranges):
    with pytest.raises(
        InputError, match="no sighting has a bearing, and ekf needs range and bearing to locate a landmark"
    ):
        run(ranges, replace(UNKNOWN, estimator="ekf"))
