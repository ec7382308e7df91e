"""Tracks: who is followed to whom, with images whose truth is known."""

import cv2
import numpy as np
import pytest

from factorgraph_loc.vision import tracks as tracking
from factorgraph_loc.vision.tracks import FeatureTracker, pairs
from factors.camera.model import CameraModel, project, undistorted

pytestmark = pytest.mark.kernels

CAMERA = CameraModel(fx=500.0, fy=500.0, cx=319.5, cy=239.5, width=640, height=480, distortion=(0.05, 0.0, 0.0, 0.0))


def scene(rng, count=150):
    """Points (N, 3) in front of a camera, and descriptors (N, 32) of length one that tell them apart."""
    points = np.column_stack((rng.uniform(-3, 3, count), rng.uniform(-2, 2, count), rng.uniform(4, 9, count)))
    looks = rng.normal(size=(count, 32))
    return points, (looks / np.linalg.norm(looks, axis=1, keepdims=True)).astype(np.float32)


def view(points, place, turn=0.0, noise=0.0, rng=None):
    """Pixels (N, 2) of a camera at ``place`` (3,), turned about its y axis."""
    c, s = np.cos(turn), np.sin(turn)
    local = (points - place) @ np.array(((c, 0.0, -s), (0.0, 1.0, 0.0), (s, 0.0, c))).T
    pixels = project(CAMERA, local)
    return pixels if rng is None else pixels + rng.normal(scale=noise, size=pixels.shape)


def followed(images):
    tracker = FeatureTracker(CAMERA)
    return [tracker.follow(pixels, looks) for pixels, looks in images]


def paired(first, first_looks, second, second_looks):
    views = ((undistorted(CAMERA, first), first_looks), (undistorted(CAMERA, second), second_looks))
    return pairs(*views, CAMERA)


def drive(rng, steps=8):
    points, looks = scene(rng)
    return points, looks, [view(points, np.array((0.05 * k, 0.0, 0.1 * k)), 0.02 * k, 0.3, rng) for k in range(steps)]


def test_what_is_seen_all_the_way_keeps_its_number():
    _, looks, views = drive(np.random.default_rng(1))
    tracks = followed([(pixels, looks) for pixels in views])
    for numbers in tracks:
        assert len(set(numbers.tolist())) == len(numbers)
    kept = np.mean(tracks[0] == tracks[-1])
    assert kept > 0.95
    assert all(np.isin(tracks[-1][tracks[-1] != tracks[0]], tracks[0], invert=True))


def test_order_of_the_features_does_not_matter():
    rng = np.random.default_rng(2)
    _, looks, views = drive(rng, steps=3)
    shuffled = rng.permutation(len(looks))
    tracks = followed([(views[0], looks), (views[1][shuffled], looks[shuffled]), (views[2], looks)])
    assert np.mean(tracks[1] == tracks[0][shuffled]) > 0.97
    assert np.mean(tracks[2] == tracks[0]) > 0.95


def test_a_missed_detection_is_bridged_and_two_are_not():
    _, looks, views = drive(np.random.default_rng(3), steps=6)
    keep = np.arange(len(looks)) >= 40  # the first 40 are not found in some images
    once = followed([(v[keep], looks[keep]) if k == 2 else (v, looks) for k, v in enumerate(views)])
    assert np.mean(once[1][:40] == once[3][:40]) > 0.9
    twice = followed([(v[keep], looks[keep]) if k in (2, 3) else (v, looks) for k, v in enumerate(views)])
    assert not set(twice[1][:40].tolist()) & set(twice[4][:40].tolist())
    assert np.mean(twice[1][40:] == twice[4][40:]) > 0.9


def test_wrong_matches_are_taken_out():
    """40 % of the features look like another one: of random pairs some lie at the epipolar line by chance."""
    rng = np.random.default_rng(4)
    points, looks = scene(rng, 300)
    first, second = (view(points, np.array((x, 0.0, z)), 0.0, 0.3, rng) for x, z in ((0.0, 0.0), (0.1, 0.1)))
    wrong = np.arange(300) < 120
    seen = np.array(looks)
    seen[wrong] = looks[np.roll(np.flatnonzero(wrong), 1)]
    found = paired(first, looks, second, seen)
    right = found[:, 0] == found[:, 1]
    assert right.sum() > 0.95 * 180
    assert (~right).sum() < 0.1 * 120


def test_a_moving_object_is_followed_by_itself():
    rng = np.random.default_rng(5)
    points, looks = scene(rng, 300)
    first, second = (view(points, np.array((x, 0.0, 0.0)), 0.0, 0.2, rng) for x in (0.0, 0.15))
    moving = np.arange(300) < 100  # a third of the image moves up by 20 px: across the epipolar lines
    second[moving] -= (0.0, 20.0)
    wrong = np.arange(300) % 5 == 0
    seen = np.array(looks)
    seen[wrong] = looks[np.roll(np.flatnonzero(wrong), 1)]
    found = paired(first, looks, second, seen)
    right = found[:, 0] == found[:, 1]
    assert np.count_nonzero(found[right, 0] < 100) > 0.8 * 80
    assert np.count_nonzero(found[right, 0] >= 100) > 0.95 * 160
    assert np.count_nonzero(~right) < 0.2 * 60


def test_the_room_beside_an_object_with_most_of_the_features_is_followed_too():
    rng = np.random.default_rng(5)
    points, looks = scene(rng, 300)
    first, second = (view(points, np.array((0.0, 0.0, z)), turn, 0.2, rng) for z, turn in ((0.0, 0.0), (0.1, 0.08)))
    sliding = np.arange(300) < 240
    first[sliding] = rng.uniform((320.0, 20.0), (500.0, 460.0), (240, 2))
    second[sliding] = first[sliding] + (60.0, 0.0) + rng.normal(scale=0.2, size=(240, 2))
    found = paired(first, looks, second, looks)
    assert np.count_nonzero(found[:, 0] < 240) > 0.95 * 240
    assert np.count_nonzero(found[:, 0] >= 240) > 0.9 * 60


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_camera_that_stands_still_keeps_everything(noise):
    rng = np.random.default_rng(6)
    points, looks = scene(rng)
    tracks = followed([(view(points, np.zeros(3), 0.0, noise, rng), looks) for _ in range(4)])
    assert np.mean(tracks[0] == tracks[-1]) > 0.95


def test_a_camera_that_only_turns():
    rng = np.random.default_rng(7)
    points, looks = scene(rng)
    tracks = followed([(view(points, np.zeros(3), 0.1 * k, 0.3, rng), looks) for k in range(3)])
    assert np.mean(tracks[0] == tracks[-1]) > 0.9


def test_what_looks_alike_far_away_is_not_followed():
    _, looks, (first,) = drive(np.random.default_rng(8), steps=1)
    far = first + np.array((0.3 * CAMERA.width, 0.0))
    first_tracks, second_tracks = followed([(first, looks), (far, looks)])
    assert np.mean(np.isin(second_tracks, first_tracks)) < 0.1


def test_images_without_features():
    _, looks, views = drive(np.random.default_rng(9), steps=3)
    nothing = (np.empty((0, 2)), np.empty((0, 32), dtype=np.float32))
    assert followed([]) == []
    assert [len(numbers) for numbers in followed([nothing, nothing, nothing])] == [0, 0, 0]
    tracks = followed([(views[0], looks), nothing, (views[2], looks), nothing, nothing, (views[1], looks)])
    assert np.mean(tracks[0] == tracks[2]) > 0.9  # bridged
    assert not set(tracks[2].tolist()) & set(tracks[5].tolist())


def test_bits_and_few_features():
    rng = np.random.default_rng(10)
    points, _ = scene(rng, 10)
    bits = rng.integers(0, 256, (10, 32), dtype=np.uint8)
    first, second = view(points, np.zeros(3)), view(points, np.array((0.05, 0.0, 0.0)))
    tracks = followed([(first, bits), (second, bits)])
    np.testing.assert_array_equal(tracks[0], tracks[1])


def test_where_no_geometry_is_found_the_looks_decide(monkeypatch):
    def fail(*_):
        raise cv2.error("as OpenCV does now and then")

    monkeypatch.setattr(tracking.cv2, "findEssentialMat", fail)
    _, looks, views = drive(np.random.default_rng(12), steps=2)
    assert len(paired(views[0], looks, views[1], looks)) > 140
