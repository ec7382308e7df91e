"""Wheels that slipped between two keyframes are told from noise by the points that both see, and from what moves by itself,
however much of the image it covers."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from factorgraph_loc.fusion.graph.graph import Keyframe
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.settings import Estimated
from factorgraph_loc.slam.keyframe_cameras import KeyframeCameras
from factorgraph_loc.slam.moving_things import MovingThings
from factorgraph_loc.slam.slipping import moved_since, unless_slipped
from factorgraph_loc.slam.unknown_points import UnknownPoints, _Point
from factors import se2
from factors.camera.model import PARAMETERS, CameraModel, predict
from factors.motion import ChainState, Increment, propagate
from factors.odometry.model import Growth, OdometryModel, relative_motion, slip

MODEL = CameraModel(370.0, 370.0, 240.0, 180.0, width=480, height=360, position=np.array((0.1, 0.0, 0.6)))
WHEELS = OdometryModel(
    along=Growth(0.05, 0.0, 0.005), lateral=Growth(0.02, 0.0, 0.005), heading=Growth(0.05, 0.05, 0.002)
)
RESTS, DRIVES = (0.0, 0.6), (0.27, 0.0)  # m driven, s at rest, of 0.6 s
SURVEYED = 0.03  # m, standard deviation of points


def step_and_pixels(way, rest, slid, rng, count):
    """A step of 0.6 s as wheels tell it, and what is seen at its end by a robot that slid by ``slid`` (3,) besides."""
    states = ChainState(0.0, *np.zeros(7)), ChainState(0.6, way, 0.0, 0.0, way, 0.0, 0.0, rest)
    step = relative_motion(WHEELS, *states)
    moved = se2.compose(step.delta, se2.exp(np.linalg.cholesky(step.covariance) @ rng.standard_normal(3)))
    points = rng.uniform((2.0, -1.0, 0.0), (6.0, 1.0, 1.5), (count, 3))
    seen = points + SURVEYED * rng.standard_normal((count, 3))
    pixels, _ = predict(MODEL, se2.compose(moved, np.asarray(slid)), seen)
    return step, points, pixels + rng.standard_normal((count, 2))


def widened(way, rest, slid, seed, count=20):
    """Whether a step counts as one in which wheels slipped."""
    step, points, pixels = step_and_pixels(way, rest, slid, np.random.default_rng(seed), count)
    keyframe = Keyframe(1, 0.6, ChainState(0.6, *np.zeros(7)), step)
    guess = step.delta, step.covariance
    spreads = np.broadcast_to(SURVEYED**2 * np.eye(3), (count, 3, 3))
    noise = np.broadcast_to(25.0 * np.eye(2), (count, 2, 2))
    told = unless_slipped(
        MODEL, keyframe, guess, lambda s: slip(WHEELS, s, use_gyro=False), (points, pixels, spreads, noise)
    )
    assert (told is guess) == (keyframe.from_previous is step)
    return keyframe.from_previous is not step


@pytest.mark.parametrize("slid", [(0.0, 0.0, 0.2), (0.02, 0.0, -0.2), (-0.1, 0.0, 0.25)])
@pytest.mark.parametrize("motion", [RESTS, DRIVES], ids=["at rest", "driving"])
def test_a_slip_is_seen(motion, slid):
    assert sum(widened(*motion, slid, seed) for seed in range(20)) == 20


@pytest.mark.parametrize("motion", [RESTS, DRIVES], ids=["at rest", "driving"])
def test_noise_is_no_slip(motion):
    assert not any(widened(*motion, np.zeros(3), seed) for seed in range(100))


def test_few_points_tell_nothing_of_the_wheels():
    assert not any(widened(*DRIVES, (0.0, 0.0, 0.3), seed, count=5) for seed in range(20))


def test_sideways_wheels_are_held():
    spread, _ = slip(WHEELS, Increment(np.array((0.3, 0.0, 0.0)), np.eye(3), 0.5), use_gyro=False)
    along, aside, heading = np.diag(spread)
    assert along > 0.0
    assert heading > 0.0
    assert aside == pytest.approx(heading * 0.3**2 / 3.0)  # a turn on the way displaces the end
    gyro, _ = slip(WHEELS, Increment(np.array((0.3, 0.0, 0.0)), np.eye(3), 0.5), use_gyro=True)
    assert np.diag(gyro)[1:] == pytest.approx(0.0)


def test_how_far_the_motion_is_known_of_some_seconds():
    rng = np.random.default_rng(3)
    steps = [Increment(rng.normal(size=3), np.diag(rng.uniform(0.01, 0.1, 3)) ** 2, 1.0) for _ in range(9)]
    keyframes = {i: Keyframe(i, float(i), ChainState(float(i), *np.zeros(7)), step) for i, step in enumerate(steps)}
    expected = np.zeros((3, 3))
    for step in steps[6:]:
        expected = propagate(expected, step)
    np.testing.assert_allclose(moved_since(keyframes, keyframes[8], 5.0, 60), expected)
    np.testing.assert_allclose(moved_since(keyframes, keyframes[8], 5.9, 60), expected)
    np.testing.assert_allclose(moved_since(keyframes, keyframes[8], 0.0, 3), expected)
    keyframes[5].from_previous = None  # the robot was carried there
    np.testing.assert_allclose(moved_since(keyframes, keyframes[8], 0.0, 60), expected)
    assert moved_since(keyframes, keyframes[5], 0.0, 60) is None


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
        assert len(things.moving & {f"object{i}" for i in range(OBJECT)}) > 0.8 * OBJECT
        assert sum(things.is_static(f"room{i}") for i in range(ROOM)) >= 0.9 * ROOM
        assert not any(things.is_static(name) for name in things.moving)
        assert not things.is_static("new")


def test_an_object_that_is_too_slow_for_one_step_is_seen_to_move_over_several():
    """Its motion in one step may be an error of the wheels."""
    for seed in SEEDS:
        things = looked(seed, across=SLOW, images=4)
        assert len(things.moving & {f"object{i}" for i in range(OBJECT)}) > 0.8 * OBJECT
        assert sum(things.is_static(f"room{i}") for i in range(ROOM)) >= 0.8 * ROOM


@pytest.mark.parametrize("slid", [(0.0, 0.0, 0.2), (0.05, 0.0, -0.2), (-0.1, 0.0, 0.1), (0.0, 0.0, 0.0)])
def test_wheels_that_slip_are_no_moving_thing(slid):
    for seed in SEEDS:
        things = looked(seed, slid=slid, room=60, count=0)
        assert not things.moving
        assert things.is_static("room0")
        assert things.is_static("new")


GUESS = np.zeros(3), np.diag((0.2, 0.2, 0.05)) ** 2
KNOWN, SLIPPED = np.diag((0.05, 0.05, 0.02)) ** 2, np.diag((0.3, 0.3, 0.15)) ** 2
FEW = np.array(((3.0, -0.5, 0.4), (4.0, 0.6, 1.0), (5.0, -0.2, 1.4), (2.5, 0.3, 0.7)))


def placed(moved, last, step=KNOWN):
    """The pose (3,) from four points that were seen at ``last`` [s], by a robot that ``moved`` (3,) from its guess after a ``step``
    of this covariance (3, 3); and how many of them count."""
    points = UnknownPoints(MODEL, Diagnostics())
    known = [_Point(i, last, 1e4 * np.eye(3)) for i in range(len(FEW))]
    keyframes = [
        Keyframe(i, t, ChainState(t, *np.zeros(7)), Increment(np.zeros(3), step, t - 4.0))
        for i, t in ((0, 4.0), (1, 10.0))
    ]
    motion = SimpleNamespace(slip=lambda _: (np.zeros((3, 3)), np.inf))
    graph = SimpleNamespace(current=FEW.__getitem__, keyframes=keyframes, motion=motion)
    pixels, _ = predict(MODEL, se2.exp(np.asarray(moved)), FEW)
    none = np.zeros(len(FEW), dtype=bool)
    named = SimpleNamespace(names=tuple("abcd"))
    image = SimpleNamespace(m=named, keyframe=keyframes[1], graph=graph, model=MODEL)
    (pose, _), _, _, right = points._corrected(image, known, pixels, GUESS, none)
    return pose, np.count_nonzero(right)


@pytest.mark.parametrize("last", [9.5, 1.0])
def test_points_place_a_robot_near_its_guess(last):
    moved = (0.1, -0.1, 0.04)
    pose, count = placed(moved, last)
    assert count == len(FEW)
    assert np.allclose(pose, se2.exp(np.array(moved)), atol=0.02)


@pytest.mark.parametrize("moved", [(0.1, -0.2, 0.4), (0.5, 0.0, 0.0)], ids=["from its guess", "since they were seen"])
def test_a_few_points_seen_lately_do_not_place_it_where_it_cannot_be(moved):
    """They agree, which wrong matches do, too; seen long ago, they may close a loop."""
    pose, count = placed(moved, 9.5)
    assert count == 0
    assert np.array_equal(pose, GUESS[0])
    pose, count = placed(moved, 1.0)
    assert count == len(FEW)
    assert np.allclose(pose, se2.exp(np.array(moved)), atol=0.08)


def test_wheels_that_slipped_may_have_taken_it_far():
    moved = (0.5, 0.0, 0.0)
    pose, count = placed(moved, 9.5, SLIPPED)
    assert count == len(FEW)
    assert np.allclose(pose, se2.exp(np.array(moved)), atol=0.08)


LENS = CameraModel(370.0, 370.0, 240.0, 180.0, width=480, height=360)
OFFSET, SIGMA, TWIST = 0.4, 0.05, np.array((0.8, -0.1, 0.9))
POSE = np.array((2.0, -1.0, 0.7))
ROOT = np.array(((0.1, 0.0, 0.0), (0.02, 0.2, 0.0), (0.0, -0.03, 0.06)))
STEP = 1e-6
GRAPH = SimpleNamespace(
    mapped_constants=7,
    values={7: np.array((0.02, OFFSET))},
    covariances={7: np.diag((0.01, SIGMA)) ** 2},
    motion=SimpleNamespace(twist=lambda _: TWIST),
)


@pytest.fixture
def cameras():
    sigmas = np.array([{"focal": 0.01, "time_offset": SIGMA}.get(name, 0.0) for name in PARAMETERS])
    found = KeyframeCameras(LENS, Estimated.among(PARAMETERS, sigmas))
    found.add(Keyframe(3, 1.5, ChainState(1.5, *np.zeros(7)), None), GRAPH)
    return found


def at_image(xi, offset):
    """The pose at the time of the image, of a robot that is at POSE moved by ``xi`` (3,) at the stamp."""
    return se2.compose(se2.compose(POSE, se2.exp(xi)), se2.exp(offset * TWIST))


def test_the_covariance_at_the_image_is_that_of_the_motion_to_it(cameras):
    pose, covariance = cameras.at_image(3, (POSE, ROOT @ ROOT.T), GRAPH)
    expected = at_image(np.zeros(3), OFFSET)
    assert pose == pytest.approx(expected)
    moved = [at_image(STEP * axis, OFFSET) for axis in np.eye(3)] + [at_image(np.zeros(3), OFFSET + STEP)]
    jacobian = np.column_stack([se2.log(se2.between(expected, there)) / STEP for there in moved])
    before = np.zeros((4, 4))
    before[:3, :3], before[3, 3] = ROOT @ ROOT.T, SIGMA**2
    assert covariance == pytest.approx(jacobian @ before @ jacobian.T, rel=1e-4, abs=1e-8)


def test_the_pose_at_the_stamp_is_that_before_the_motion_to_the_image(cameras):
    guess = POSE, ROOT @ ROOT.T
    pose, covariance = cameras.at_stamp(3, cameras.at_image(3, guess, GRAPH), GRAPH)
    assert pose == pytest.approx(guess[0])
    assert covariance == pytest.approx(guess[1])


def test_keyframes_that_are_forgotten_leave_nothing(cameras):
    cameras.anchor(Keyframe(3, 1.5, ChainState(1.5, *np.zeros(7)), None), 9)
    cameras.forget(3)
    assert cameras.twists.keys() == cameras.anchored.keys() == {3}
    cameras.forget(4)
    assert not cameras.twists
    assert not cameras.anchored
