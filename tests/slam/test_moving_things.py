"""What moves by itself is told from wheels that slip, however much of the image it covers."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from factorgraph_loc.fusion.graph.graph import Keyframe
from factorgraph_loc.slam.moving_things import MovingThings
from factors import se2
from factors.camera.model import CameraModel, predict
from factors.motion import ChainState
from factors.odometry.model import Growth, OdometryModel, relative_motion

MODEL = CameraModel(370.0, 370.0, 240.0, 180.0, width=480, height=360, position=np.array((0.1, 0.0, 0.6)))
WHEELS = OdometryModel(
    along=Growth(0.05, 0.0, 0.005), lateral=Growth(0.02, 0.0, 0.005), heading=Growth(0.05, 0.05, 0.002)
)
ROOM, OBJECT = 40, 80
SEEDS = range(8)
SLOW = -4.0  # px, where what is far away moves by 18 between two images


def looked(seed, slid=(0.0, 0.0, 0.0), across=0.0, room=ROOM, count=OBJECT, images=2):
    """After ``images`` 0.6 s apart from a robot that slid by ``slid`` (3,) between the last two, besides what its wheels tell, of
    points of a room, and of ``count`` others that slide ``across`` the image [px] from one to the next."""
    rng = np.random.default_rng(seed)
    chain = [ChainState(0.6 * i, 0.2 * i, 0.0, 0.05 * i, 0.2 * i, 0.05 * i, 0.0, 0.0) for i in range(images)]
    poses = [np.zeros(3)]
    for i, (begin, end) in enumerate(pairwise(chain), 1):
        step = relative_motion(WHEELS, begin, end)
        error = np.linalg.cholesky(step.covariance) @ rng.standard_normal(3)
        moved = se2.compose(step.delta, se2.exp(error))
        poses.append(se2.compose(poses[-1], se2.compose(moved, np.asarray(slid)) if i == images - 1 else moved))
    points = rng.uniform((2.0, -1.0, 0.0), (6.0, 1.0, 1.5), (room, 3))
    others = rng.uniform((150.0, 0.0), (300.0, 360.0), (count, 2))
    names = [f"room{i}" for i in range(room)] + [f"object{i}" for i in range(count)]
    things = MovingThings(MODEL)
    graph = SimpleNamespace(between=lambda a, b: relative_motion(WHEELS, a.odometry, b.odometry))
    for i, pose in enumerate(poses):
        pixels = np.concatenate((predict(MODEL, pose, points)[0], others + np.array((i * across, 0.0))))
        seen = pixels + rng.standard_normal(pixels.shape)
        things.learn(Keyframe(i, 0.6 * i, chain[i], None), names, seen, graph)
    return things


@pytest.mark.parametrize("across", [-60.0, 90.0])
def test_an_object_that_has_most_of_the_tracks_is_seen_to_move(across):
    for seed in SEEDS:
        things = looked(seed, across=across)
        # a few features of either agree with both motions
        assert len(things.moving() & {f"object{i}" for i in range(OBJECT)}) > 0.8 * OBJECT
        assert sum(things.is_static(f"room{i}") for i in range(ROOM)) >= 0.9 * ROOM
        assert not any(things.is_static(name) for name in things.moving())
        assert not things.is_static("new")


def test_an_object_that_is_too_slow_for_one_step_is_seen_to_move_over_several():
    """Its motion in one step may be an error of the wheels."""
    for seed in SEEDS:
        things = looked(seed, across=SLOW, images=4)
        assert len(things.moving() & {f"object{i}" for i in range(OBJECT)}) > 0.8 * OBJECT
        assert sum(things.is_static(f"room{i}") for i in range(ROOM)) >= 0.8 * ROOM


@pytest.mark.parametrize("slid", [(0.0, 0.0, 0.2), (0.05, 0.0, -0.2), (-0.1, 0.0, 0.1), (0.0, 0.0, 0.0)])
def test_wheels_that_slip_are_no_moving_thing(slid):
    for seed in SEEDS:
        things = looked(seed, slid=slid, room=60, count=0)
        assert not things.moving()
        assert things.is_static("room0")
        assert things.is_static("new")
