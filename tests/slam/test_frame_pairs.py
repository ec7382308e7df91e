"""Visual odometry as a part of a graph: which pairs of images are compared, and that no pixel counts twice."""

import camera_world
import numpy as np
import pytest

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.graph.graph import Keyframe
from factorgraph_loc.slam.frame_pairs import FramePairs
from factors import se2
from factors.camera import model as reprojection
from factors.motion import ChainState, Increment

MODEL = camera_world.CAMERA.model()
SPREAD = np.diag((0.01, 0.005, 0.01)) ** 2


def keyframe(index, t):
    return Keyframe(index, t, ChainState(t, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), None)


def seen(pose):
    """Names and pixels of what is in view of a robot that looks into a corner; of one wall the direction of the way is vague."""
    points = camera_world.room(1000)
    pixels, depth = reprojection.predict(MODEL, se2.compose(np.array((0.5, 0.0, 0.7)), pose), points.positions)
    rows = np.flatnonzero(MODEL.contains(pixels) & (depth > 0.3))
    return [points.names[i] for i in rows], pixels[rows]


def test_a_pair_far_enough_apart_tells_turn_and_direction():
    pairs, motion = FramePairs(MODEL), np.array((0.4, 0.02, 0.1))
    assert pairs.take(keyframe(0, 0.0), *seen(np.zeros(3)), None) is None
    predicted = Increment(se2.compose(motion, np.array((0.01, 0.0, 0.01))), SPREAD, 0.5)
    first, second = keyframe(0, 0.0), keyframe(1, 0.5)
    node = pairs.take(second, *seen(motion), predicted)
    assert node is not None
    assert node.keys == (first.key, second.key)
    # the length is as predicted, so the cost of the truth is near zero and that of another turn is not
    assert node.factor.cost([np.zeros(3), motion]) < 0.5
    assert node.factor.cost([np.zeros(3), motion + np.array((0.0, 0.0, 0.02))]) > 10.0


def test_images_too_near_to_each_other_wait_for_one_farther_off():
    pairs = FramePairs(MODEL)
    pairs.take(keyframe(0, 0.0), *seen(np.zeros(3)), None)
    near, far = np.array((0.1, 0.0, 0.0)), np.array((0.35, 0.0, 0.0))
    assert pairs.take(keyframe(1, 0.2), *seen(near), Increment(near, SPREAD, 0.2)) is None
    node = pairs.take(keyframe(2, 0.6), *seen(far), Increment(far, SPREAD, 0.6))
    assert node is not None
    assert node.keys == (keyframe(0, 0.0).key, keyframe(2, 0.6).key)


def test_an_image_whose_keyframe_was_taken_back_is_forgotten():
    pairs, first, other = FramePairs(MODEL), keyframe(0, 0.0), keyframe(0, 0.0)
    pairs.take(first, *seen(np.zeros(3)), None)
    later = keyframe(1, 0.5)
    assert pairs.previous(later, {0: first, 1: later}) is first
    assert pairs.previous(later, {0: other, 1: later}) is None
    assert pairs.previous(keyframe(1, 5.0), {0: first}) is None


@pytest.mark.parametrize(("name", "landmarks"), [("smoother", "unknown"), ("batch", "known")])
def test_pixels_of_points_are_not_used_again(name, landmarks):
    log = camera_world.simulate(1, 8.0)
    plain, compared = (
        run(log, RunConfig(name, {"landmarks": landmarks, "visual_odometry": on})) for on in (False, True)
    )
    np.testing.assert_array_equal(plain.final.poses, compared.final.poses)
