"""Points in space that are estimated on the way, from their pixels in a simulated room, with and without a part of the map."""

from dataclasses import replace
from functools import cache

import camera_world
import numpy as np
import pytest
from scipy.stats import chi2

import factorgraph_loc as fgloc
from factorgraph_loc import FeatureStream, SightingStream, Trajectory, VelocityStream, World
from factorgraph_loc.evaluation.metrics import errors, score
from factorgraph_loc.experiments.output import map_of
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.graph.solver import FullHistory
from factorgraph_loc.model.log import cut
from factorgraph_loc.sensors.camera.settings import CameraUncertainty
from factors import se2
from factors.graph import pose_key

UNKNOWN = {"landmarks": "unknown"}
CONFIGS = {
    "smoother": RunConfig("smoother", UNKNOWN),
    "smoother_lag": RunConfig("smoother", {**UNKNOWN, "lag": 6.0}),
    "batch": RunConfig("batch", UNKNOWN),
}
SEEDS = range(1, 6)
SECONDS = 18.0


def with_object(log, count=40, seed=0):
    """Points of an object that covers a third of each image and slides to and fro in it."""
    rng = np.random.default_rng(seed)
    s = log.streams["sightings"]
    t = np.unique(s.t)
    u = 213.0 * (1.0 + np.sin(2.0 * np.pi * t / 8.0))[:, None] + rng.uniform(0.0, 213.0, count)
    v = np.tile(rng.uniform(0.0, 480.0, count), (len(t), 1))
    seen = np.stack((u, v)) + camera_world.CAMERA.pixel_sigma * rng.standard_normal((2, len(t), count))
    stamps = np.concatenate((s.t, np.repeat(t, count)))
    order = np.argsort(stamps, kind="stable")
    names = [*s.point, *[f"object{i}" for i in range(count)] * len(t)]
    columns = (np.concatenate((old, new.ravel()))[order] for old, new in zip((s.u, s.v), seen, strict=True))
    stream = SightingStream(stamps[order], [names[i] for i in order], *columns)
    return replace(log, streams={**log.streams, "sightings": stream})


@pytest.fixture(scope="module")
def logs():
    return {seed: camera_world.simulate(seed, SECONDS) for seed in SEEDS}


@pytest.fixture(scope="module")
def log(logs):
    return logs[1]


@pytest.fixture(scope="module")
def mapped(logs):
    """``mapped(name, seed)``: the result of SLAM, computed once."""
    return cache(lambda name, seed: run(logs[seed], CONFIGS[name]))


def rmse(result, log):
    return score(result, log)["final.position_rmse"]


def test_errors_are_as_large_as_the_covariances_say(mapped, logs):
    # the last pose of five runs; the mean leaves this band once in a thousand
    total = sum(errors(mapped("smoother", seed).final, logs[seed].reference).nees[-1] for seed in SEEDS)
    assert chi2.ppf(0.0005, 15) < total < chi2.ppf(0.9995, 15)


def test_an_object_with_most_of_the_points_is_not_taken_for_the_room(mapped, log):
    result = run(with_object(log), CONFIGS["smoother"])
    assert rmse(result, log) < max(2.0 * rmse(mapped("smoother", 1), log), 0.2)


def test_points_leave_the_window_and_are_kept(mapped):
    full, window = mapped("smoother", 1), mapped("smoother_lag", 1)
    assert len(window.learnt.points) > 0.8 * len(full.learnt.points)
    assert len(set(window.learnt.points.names)) == len(window.learnt.points)


def test_a_step_that_leads_astray_is_undone(mapped, log, monkeypatch):
    value, told = FullHistory.value, []

    def astray(self, key):
        found = value(self, key)
        if key != pose_key(20) or told:
            return found
        told.append(key)
        return found + np.array((5.0, 0.0, 0.0))

    monkeypatch.setattr(FullHistory, "value", astray)
    result = run(log, CONFIGS["smoother"])
    ((kind, fields),) = [(event.kind, event.fields) for event in result.diagnostics.events]
    assert (kind, fields) == ("solver_rebuilt", {"why": "the estimate jumped"})
    assert errors(result.causal(), log.reference).position.max() < 1.0
    assert rmse(result, log) < 1.2 * rmse(mapped("smoother", 1), log)


@pytest.mark.parametrize(("name", "turn"), [("smoother_lag", 0.0), ("batch", 0.4)])
def test_a_robot_at_rest_or_turning_on_the_spot(name, turn):
    camera = camera_world.CAMERA.model_copy(update={"x": 0.0, "y": 0.0})
    t = np.arange(0.0, 8.0, 0.05)
    poses = np.column_stack((0.0 * t, 0.0 * t, se2.wrap(turn * t)))
    truth, points = Trajectory(t, poses), camera_world.room()
    rng = np.random.default_rng(3)
    seen = camera_world.sightings(truth, points, np.arange(0.1, 7.9, 0.2), rng, camera)
    log = replace(
        camera_world.with_camera(camera_world.simulate(1, 2.0), x=0.0, y=0.0),
        streams={"odometry": VelocityStream(t, 0.0 * t, 0.0 * t + turn), "sightings": seen},
        reference=truth,
    )
    result = run(log, CONFIGS[name])
    assert np.all(np.isfinite(result.poses))
    assert rmse(result, log) < 0.1
    assert result.learnt.points is None or np.all(np.isfinite(result.learnt.points.covariances))


def test_points_whose_tracks_end_are_found_again(log):
    result = run(camera_world.with_tracks(log, 4.0), CONFIGS["smoother"])
    points, true = result.learnt.points, camera_world.room()
    assert rmse(result, log) < 0.25
    assert points.feature == "colour"
    assert np.array_equal(np.unique(points.owners), np.arange(len(points)))
    # a track lives for seven keyframes: without finding points again there would be each several times
    apart = np.linalg.norm(points.positions[:, None] - true.positions[None], axis=2)
    assert np.median(apart.min(axis=1)) < 0.25
    assert len(points) < 1.3 * len(np.unique(apart.argmin(axis=1)))


def test_a_track_that_comes_back_meets_the_one_that_took_its_place(log):
    # two tracks of each point take turns; now and then both are in one image
    film = camera_world.with_tracks(log, 4.0)
    frames = list(film.streams["camera"].frame)
    for k, frame in enumerate(frames):
        old = frame.tracks < 10**6
        tracks = np.where(old, frame.tracks % 1000 + 1000 * (k // 7 % 2), frame.tracks)
        both = np.flatnonzero(old)[:20] if k % 7 == 0 else np.empty(0, dtype=np.int64)
        again = frame.tracks[both] % 1000 + 1000 * (1 - k // 7 % 2)
        rows = np.concatenate((np.arange(len(tracks)), both))
        frames[k] = replace(
            frame,
            pixels=frame.pixels[rows],
            descriptors=frame.descriptors[rows],
            tracks=np.concatenate((tracks, again)),
        )
    streams = {**film.streams, "camera": FeatureStream(film.streams["camera"].t, frames)}
    assert rmse(run(replace(film, streams=streams), CONFIGS["smoother"]), log) < 0.25


def test_few_features_that_cannot_confirm_each_other_are_not_believed():
    """For 6 s three tracks are left, which slip: the robot goes on by its wheels, as with nothing to see."""
    film = camera_world.with_tracks(camera_world.simulate(1, 11.0), 100.0)
    ends = []
    for left in (3, 0):
        frames = []
        for t, frame in zip(film.streams["camera"].t.tolist(), film.streams["camera"].frame, strict=True):
            there = np.flatnonzero(frame.tracks < 10**6)
            rows = there[:left] if 4.0 < t < 10.0 else np.arange(len(frame.tracks))
            slipped = 40.0 * (t - 4.0) if 4.0 < t < 10.0 else 0.0
            parts = {name: getattr(frame, name)[rows] for name in ("descriptors", "tracks")}
            frames.append(replace(frame, pixels=frame.pixels[rows] + (slipped, 0.0), **parts))
        streams = {**film.streams, "camera": FeatureStream(film.streams["camera"].t, frames)}
        found = run(replace(film, streams=streams), CONFIGS["smoother"])
        ends.append(found.poses[np.searchsorted(found.t, 9.5)])
    np.testing.assert_allclose(ends[0], ends[1], atol=0.02)


def test_a_few_named_points_close_a_loop():
    """Some five points are in an image, so few of them come back at once; the error was 0.2 m to 0.4 m when six were needed."""
    changed = {"world": {"tags": 1, "points": 150}, "pixels": {"rate": 5.0}, "drive": {"duration": 200.0}}
    log = fgloc.simulate("office", 104, changes=changed)
    result = run(log, RunConfig("smoother", UNKNOWN, ("odometry", "sightings")))
    assert score(result, log)["final.aligned_position_rmse"] < 0.16


def test_points_without_a_map_tell_the_time_offset():
    """Four standard deviations: below 1e-4 of false alarms."""
    log = camera_world.simulate(1, SECONDS, speeds=camera_world.weave)
    stamped = camera_world.with_sightings(log, t=log.streams["sightings"].t + 0.1)
    unsure = camera_world.with_camera(stamped, uncertainty=CameraUncertainty(time_offset=0.1))
    offset, sigma = run(unsure, CONFIGS["smoother"]).learnt.values["camera.time_offset"]
    assert abs(offset + 0.1) < 4.0 * sigma
    assert sigma < 0.03


DAY = 24.0
DAYS = range(21, 24)


def filmed(seed, speeds):
    """A drive through the room with features that are followed for four seconds, and no map."""
    return camera_world.with_tracks(camera_world.simulate(seed, DAY, speeds=speeds), 4.0, seed, begin=0.3, every=0.4)


@pytest.fixture(scope="module")
def days():
    """Of each seed the map of a first drive, and the log of a second one in it."""
    found = {}
    for seed in DAYS:
        monday, tuesday = filmed(seed, camera_world.circle), filmed(seed + 100, camera_world.weave)
        found[seed] = replace(tuesday, world=map_of(run(monday, CONFIGS["smoother"]), monday))
    return found


@pytest.mark.parametrize("name", ["smoother", "monoslam"])
def test_the_error_of_the_map_is_in_the_covariances(days, name):
    """Within one drive it is nearly the same all the time: each drive counts for one pose. False alarm: one in a thousand."""
    found = [score(run(log, RunConfig(name)), log) for log in days.values()]
    low, high = chi2.ppf((0.0005, 0.9995), 3 * len(found)) / len(found)
    for kind in ("causal", "final"):
        assert low < np.mean([one[f"{kind}.anees"] for one in found]) < high
        assert np.sqrt(np.mean([one[f"{kind}.position_rmse"] ** 2 for one in found])) < 0.25


def test_what_the_map_may_be_wrong_by_is_told_once(days):
    log = cut(days[DAYS[0]], 0.0, 5.0)
    (told,) = (w for w in run(log, RunConfig("ekf")).warnings if w.kind == "bent_map")
    assert told.fields["median"] < 1.0
    others = (RunConfig("dead_reckoning", sensors=("odometry",)), CONFIGS["smoother"])
    assert not any(w.kind == "bent_map" for config in others for w in run(log, config).warnings)


def test_points_are_known_from_several_sides(days):
    points = days[DAYS[0]].world.points
    counts = np.bincount(points.owners, minlength=len(points))
    assert counts.min() == 1
    assert 2 <= counts.max() <= 4
    twice = np.flatnonzero(counts >= 2)
    apart = [np.ptp(points.seen_from[points.owners == i], axis=0).max() for i in twice.tolist()]
    assert np.median(apart) > 0.3  # m, after 0.5 m of the way


def test_points_that_a_map_lacks_are_added_to_it(days):
    log = cut(days[DAYS[0]], 0.0, 12.0)
    half = np.flatnonzero(log.world.points.positions[:, 0] < 0.0)
    known = replace(log, world=World(points=log.world.points.chosen(half)))
    found = map_of(run(known, RunConfig("smoother", {"landmarks": "extended"})), known)
    assert set(known.world.points.names) <= set(found.points.names)
    assert len(found.points) > len(half) + 10
    assert map_of(run(log, RunConfig("smoother")), log) is None
