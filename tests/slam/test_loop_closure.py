"""Old points that are seen again: when that is believed, and that it takes drift back without ever doing harm."""

from dataclasses import replace

import camera_world
import numpy as np
import pytest

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.graph.graph import Keyframe
from factorgraph_loc.fusion.graph.problem import Problem
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.slam import loop_closure
from factorgraph_loc.slam.keyframe_cameras import LocalBundle, bundled
from factorgraph_loc.slam.loop_closure import Image, LoopClosure, OldPoints
from factorgraph_loc.slam.new_points import sightings_of
from factors import se2
from factors.camera import model as reprojection
from factors.camera.point import PointFactor
from factors.graph import PriorFactor, VectorPriorFactor, point_key, pose_key, tilt_key
from factors.least_squares import descended
from factors.motion import ChainState, Increment
from factors.odometry.factor import OdometryFactor, OdometryStack
from tests.slam.test_slam_points import rmse

MODEL = camera_world.CAMERA.model()
POSES = np.array([(0.0, 0.1 * i, 0.05 * i) for i in range(5)])
DRIFT = np.array((0.2, -0.15, 0.03))
SIGMAS = np.array((0.15, 0.15, 0.04))


def looked(points):
    return camera_world.with_views(points, views=1)


def shown(film, off=DRIFT, memory=None, sigmas=SIGMAS, way=10.0):
    """What is said of images of the points ``film`` from :data:`POSES`, on a track that is ``off`` them, by one that knows
    ``memory``; and which points the features really show."""
    rng = np.random.default_rng(4)
    memory = film if memory is None else memory
    keys = [point_key(i) for i in range(len(memory))]
    estimates = dict(zip(keys, memory.positions, strict=True))
    old = OldPoints(memory, keys, np.zeros(len(memory)))
    closure, said = LoopClosure(), []
    for i, pose in enumerate(POSES):
        frame, truth = camera_world.frame(film, pose, float(i), rng)
        guess = se2.compose(pose, np.broadcast_to(off, (len(POSES), 3))[i])
        estimates[pose_key(i)] = guess
        keyframe = Keyframe(i, float(i), None, None)
        image = Image(frame, keyframe, (guess, np.diag(sigmas**2)), way)
        assert closure.is_due(keyframe.t)
        said.append((closure.compare(MODEL, image, old, estimates.__getitem__), truth))
    return said


AWAY = np.array((100.0, 0.0, 0.0))
ROOM = looked(camera_world.room(400))


def test_three_images_that_agree_are_believed():
    said = shown(ROOM)
    assert [found is not None for found, _ in said] == [False, False, True, True, True]
    for (found, truth), pose in list(zip(said, POSES, strict=True))[2:]:
        off = se2.between(pose, found.pose)
        assert np.hypot(*off[:2]) < 0.03
        assert abs(off[2]) < 0.01
        assert len(found.points) >= loop_closure.FEWEST
        # of two that happen to look alike within the gate one may be taken for the other
        assert np.mean(truth[found.features] == found.points) > 0.95


def test_images_that_contradict_the_odometry_are_not_believed():
    # the track says that the robot went 0.7 m between images, which show it at one place after the other
    offs = np.array([(0.35 * (-1) ** i, 0.0, 0.0) for i in range(5)])
    assert not any(found for found, _ in shown(ROOM, off=offs, sigmas=2.0 * SIGMAS))
    assert any(found for found, _ in shown(ROOM, off=offs[:1], sigmas=2.0 * SIGMAS))


def test_what_is_farther_off_than_the_track_may_have_drifted_is_another_place():
    # a wall that looks the same 0.8 m farther on
    off = np.array((0.0, 0.8, 0.0))
    assert not any(found for found, _ in shown(ROOM, off=off))
    assert any(found for found, _ in shown(ROOM, off=off, way=200.0))
    assert any(found for found, _ in shown(ROOM, off=off, sigmas=3.0 * SIGMAS))


def test_another_room_is_not_taken_for_this_one():
    assert not any(found for found, _ in shown(looked(camera_world.room(400, seed=7)), memory=otherwise(ROOM)))


def otherwise(points):
    """The same points that look otherwise."""
    rng = np.random.default_rng(11)
    return replace(points, descriptors=rng.standard_normal(points.descriptors.shape).astype(np.float32))


@pytest.mark.parametrize("half", [0.4, 4.0])
def test_a_single_poster_is_not_enough(half):
    # 60 points on the wall ahead: on a poster of 0.8 m, seen from 4 m, or all over the wall
    rng = np.random.default_rng(2)
    y, z = rng.uniform(-half, half, 60), 1.2 + rng.uniform(-0.4, 0.4, 60)
    poster = looked(PointMap.of(tuple(map(str, range(60))), np.column_stack((np.full(60, 4.0), y, z))))
    assert any(found for found, _ in shown(poster)) == (half > 1.0)


def test_no_image_twice_a_second():
    closure = LoopClosure()
    keyframe = Keyframe(0, 3.0, None, None)
    frame, _ = camera_world.frame(ROOM, POSES[0], 3.0, np.random.default_rng(1))
    nothing = OldPoints(ROOM, [point_key(i) for i in range(len(ROOM))], np.zeros(len(ROOM)))
    closure.compare(MODEL, Image(frame, keyframe, (AWAY, np.eye(3)), 0.0), nothing, {}.__getitem__)
    assert not closure.is_due(3.5)
    assert closure.is_due(4.0)


def laps(points, seconds=48.0):
    """Two rounds in a room; no track lasts for more than ten seconds."""
    return camera_world.with_tracks(camera_world.simulate(3, seconds), 10.0, points=points, every=0.6)


def both(log, monkeypatch):
    """Errors [m] with loops closed, and without."""
    config = RunConfig("smoother", {"landmarks": "unknown"})
    closed = rmse(run(log, config), log)
    monkeypatch.setattr(LoopClosure, "is_due", lambda *_: False)
    return closed, rmse(run(log, config), log)


def test_a_second_round_takes_the_drift_back(monkeypatch):
    with_loops, without = both(laps(looked(camera_world.room(200))), monkeypatch)
    assert with_loops < 0.7 * without


def test_walls_that_look_alike_do_no_harm(monkeypatch):
    # each wall is the one before, turned by a quarter, and each metre of it is the one before
    rng = np.random.default_rng(6)
    count, repeats = 12, 8
    along, height = rng.uniform(-4.0, -3.0, count), rng.uniform(0.3, 2.4, count)
    wall = np.array([(4.0, a + k, z) for k in range(repeats) for a, z in zip(along, height, strict=True)])
    quarter = np.array(((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    positions = np.concatenate([wall @ np.linalg.matrix_power(quarter, k) for k in range(4)])
    alike = looked(PointMap.of(tuple(map(str, range(len(positions)))), positions))
    looks = rng.standard_normal((count, alike.descriptors.shape[1])).astype(np.float32)
    alike = replace(alike, descriptors=np.tile(looks, (4 * repeats, 1)))
    with_loops, without = both(laps(alike), monkeypatch)
    assert with_loops < 1.05 * without


TURN = 0.015  # rad, that the odometry is off by from one keyframe to the next
STEPS = np.array((0.0, 0.4, 0.8, 1.2, 1.6))


def drive(rng, wrong=0.0, slip=0.0):
    """True poses, keyframes, poses by odometry, which misses a turn ``slip`` [rad] in the third step, and what waits: named points
    with noise of a pixel."""
    truth = np.column_stack((STEPS - 2.0, 0.0 * STEPS, 0.1 * STEPS))
    guess, keyframes = [truth[0]], [Keyframe(0, 0.0, ChainState(0.0, *truth[0], 0.0, 0.0, 0.0), None)]
    for k in range(1, len(truth)):
        off = TURN * rng.standard_normal() - slip * (k == 3)
        moved = se2.compose(se2.between(truth[k - 1], truth[k]), np.array((0.0, 0.0, off)))
        increment = Increment(moved, np.diag((0.01, 0.01, TURN)) ** 2, 0.6)
        keyframes.append(Keyframe(k, 0.6 * k, keyframes[0].odometry, increment))
        guess.append(se2.compose(guess[-1], moved))
    points, waiting = camera_world.room(240), {}
    for k, pose in enumerate(truth):
        pixels, depth = reprojection.predict(MODEL, pose, points.positions)
        rows = np.flatnonzero(MODEL.contains(pixels) & (depth > 0.3))
        noisy = pixels[rows] + rng.standard_normal((len(rows), 2))
        bad = rng.random(len(rows)) < wrong
        noisy[bad] = rng.uniform((0.0, 0.0), (640.0, 480.0), (int(bad.sum()), 2))
        for row, sighting in zip(rows.tolist(), sightings_of(MODEL, k, noisy), strict=True):
            waiting.setdefault(row, []).append(sighting)
    return truth, keyframes, guess, waiting


def turn_errors(poses, truth):
    return np.abs(se2.wrap(np.array(poses)[:, 2] - truth[:, 2]))


def test_points_tell_the_turns_much_better_than_odometry():
    for wrong in (0.0, 0.1):
        for seed in range(4):
            truth, keyframes, guess, waiting = drive(np.random.default_rng(seed), wrong=wrong)
            found = bundled(MODEL, keyframes, guess, waiting)
            assert found is not None
            poses = [pose for pose, _ in found]
            np.testing.assert_allclose(poses[0], truth[0], atol=1e-3)
            assert turn_errors(poses, truth).max() < max(0.3 * turn_errors(guess, truth).max(), 0.008)


def test_points_tell_turns_that_slipping_wheels_miss():
    for slip in (-0.3, 0.3):
        for seed in range(4):
            truth, keyframes, guess, waiting = drive(np.random.default_rng(seed), slip=slip)
            found = bundled(MODEL, keyframes, guess, waiting)
            assert found is not None
            assert turn_errors([pose for pose, _ in found], truth).max() < 0.02


def test_keyframes_before_a_gap_in_what_is_seen_are_left_as_they_are():
    """Two tracks across the gap are wrong, and would turn what comes after."""
    truth, keyframes, guess, waiting = drive(np.random.default_rng(0))
    apart = {name: [s for s in seen if s.keyframe >= 2] for name, seen in waiting.items()}
    names = list(apart)
    for name, other in ((names[0], names[1]), (names[1], names[0])):
        apart[name] = waiting[other][:2] + waiting[name][2:]
    found = bundled(MODEL, keyframes, guess, apart)
    assert found is not None
    assert len(found) == 3
    np.testing.assert_allclose(found[0][0], guess[2], atol=1e-3)
    turned = se2.between(found[0][0], found[-1][0])[2] - se2.between(truth[2], truth[-1])[2]
    assert abs(turned) < 0.01


def test_few_points_tell_nothing():
    _, keyframes, guess, waiting = drive(np.random.default_rng(0))
    few = dict(list(waiting.items())[:6])
    assert bundled(MODEL, keyframes, guess, few) is None
    assert bundled(MODEL, keyframes[:2], guess[:2], {}) is None


def test_it_ends_where_the_general_solver_does():
    """The first pose is held there by a narrow prior."""
    rng = np.random.default_rng(1)
    truth, keyframes, guess, waiting = drive(rng)
    tilts = 0.01 * rng.standard_normal((len(truth), 2))
    names = list(waiting)[:12]
    starts = np.cumsum([0, *(len(waiting[name]) for name in names)])
    frames = np.array([s.keyframe for name in names for s in waiting[name]])
    points = camera_world.room(240).positions[names]
    steps = [k.from_previous for k in keyframes[1:]]
    lens, sigmas = reprojection.lens_of(MODEL), np.full(2, MODEL.tilt)
    pixels, values = [], {pose_key(k): pose for k, pose in enumerate(guess)}
    values |= {tilt_key(k): np.zeros(2) for k in range(len(truth))} | {point_key(p): x for p, x in enumerate(points)}
    factors = [(PriorFactor(guess[0], 1e-8 * np.eye(3)), (pose_key(0),))]
    factors += [(VectorPriorFactor(np.zeros(2), sigmas), (tilt_key(k),)) for k in range(len(truth))]
    factors += [(OdometryFactor(step), (pose_key(k), pose_key(k + 1))) for k, step in enumerate(steps)]
    for p, point in enumerate(points):
        for k in frames[starts[p] : starts[p + 1]].tolist():
            at = reprojection.camera_pose(MODEL, truth[k], tilts[k])
            pixels.append(reprojection.linearize_in_space(MODEL, *at, point[None])[0][0] + rng.standard_normal(2))
            factors.append((PointFactor(MODEL, lens, pixels[-1]), (pose_key(k), tilt_key(k), point_key(p))))
    odometry = OdometryStack([OdometryFactor(step) for step in steps], range(len(steps)), 0)
    owners = np.repeat(np.arange(len(names)), np.diff(starts))
    local = LocalBundle(MODEL, odometry, frames, owners, np.array(pixels))
    (poses, found, _), _, _ = descended(local.cost, local.moved, (np.array(guess), np.zeros((len(truth), 2)), points))
    solved = Problem(factors).solve(values).values
    np.testing.assert_allclose(poses, [solved[pose_key(k)] for k in range(len(truth))], atol=1e-4)
    np.testing.assert_allclose(found, [solved[tilt_key(k)] for k in range(len(truth))], atol=1e-4)
