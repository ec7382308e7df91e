"""Old points that are seen again: when that is believed, and that it takes drift back without ever doing harm."""

from dataclasses import replace

import camera_world
import numpy as np
import pytest

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.graph.graph import Keyframe
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.slam import loop_closure
from factorgraph_loc.slam.loop_closure import Image, LoopClosure, OldPoints
from factors import se2
from factors.graph import point_key, pose_key
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
