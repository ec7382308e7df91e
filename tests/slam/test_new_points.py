"""When a point that no map has is taken in, and where it is."""

from collections.abc import Callable

import numpy as np
import pytest
from mounted_camera import MODEL

from factorgraph_loc.slam.new_points import (
    FEWEST,
    MAX_WAITING,
    KeyframeCamera,
    NewPoints,
    PointSighting,
    TriangulatedPoint,
    sightings_of,
    triangulate,
)
from factors.camera.model import CameraModel, predict, rays
from factors.camera.triangulation_kernels import inverse_depths
from factors.se2 import Array

POINT = np.array((5.0, 2.5, 1.4))


def along(steps: Array) -> Array:
    """Poses (M, 3) on the way ahead."""
    return np.column_stack((steps, 0.1 * steps, 0.05 * steps))


def pixels_of(poses: Array, point: Array = POINT) -> Array:
    return np.array([predict(MODEL, pose, point[None])[0][0] for pose in poses])


def located(poses: Array, pixels: Array, model: CameraModel = MODEL) -> TriangulatedPoint | None:
    """The point seen from poses (M, 3) at pixels (M, 2)."""
    seen = [sightings_of(model, k, pixel[None])[0] for k, pixel in enumerate(pixels)]
    found = triangulate(model, seen, [KeyframeCamera.of(model, pose, 0.0) for pose in poses])
    return None if found is None or np.isinf(found.squared).any() else found


def seen_at(keyframe: int, pixel: Array) -> PointSighting:
    return sightings_of(MODEL, keyframe, np.asarray(pixel)[None])[0]


def test_exact_sightings_give_the_exact_place() -> None:
    poses = along(np.array((0.0, 0.5, 1.0)))
    found = located(poses, pixels_of(poses))
    assert found is not None
    np.testing.assert_allclose(found.position, POINT, atol=1e-6)


def test_errors_are_as_large_as_the_covariance_says() -> None:
    # 400 runs of 3 degrees of freedom: the mean has a standard deviation of 0.122, four of them is a false alarm in 16,000
    rng = np.random.default_rng(21)
    poses = along(np.array((0.0, 0.4, 0.8, 1.2)))
    exact = pixels_of(poses)
    squared = []
    for _ in range(400):
        found = located(poses, exact + rng.normal(0.0, 0.7, exact.shape))
        assert found is not None
        error = found.position - POINT
        squared.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(squared) == pytest.approx(3.0, abs=0.5)


def test_without_parallax_there_is_no_place() -> None:
    for steps in ((0.0, 0.0, 0.0), (0.0, 0.01, 0.02)):
        poses = along(np.array(steps))
        assert located(poses, pixels_of(poses)) is None
    turning = np.array(((0.0, 0.0, 0.0), (0.0, 0.0, 0.1), (0.0, 0.0, 0.2)))
    still = CameraModel(500.0, 500.0, 319.5, 239.5, 640, 480, position=np.array((0.0, 0.0, 0.8)))
    seen = np.array([predict(still, pose, POINT[None])[0][0] for pose in turning])
    assert located(turning, seen, still) is None


def test_rays_that_meet_behind_the_camera_are_no_point() -> None:
    poses = along(np.array((0.0, 0.5, 1.0)))
    assert located(poses, pixels_of(poses)[::-1]) is None


def places(poses: Array, slack: float = 0.0) -> Callable[[int], KeyframeCamera]:
    return lambda k: KeyframeCamera.of(MODEL, poses[k], slack)


def test_a_point_waits_for_three_sightings_and_for_parallax() -> None:
    poses = along(np.array((0.0, 0.01, 0.02, 0.03, 0.6)))
    waiting = NewPoints(MODEL)
    for k, pixel in enumerate(pixels_of(poses)):
        assert waiting.ready(["a"], places(poses)) == []
        waiting.add("a", seen_at(k, pixel))
    ((name, found, sightings),) = waiting.ready(["a", "b"], places(poses))
    assert name == "a"
    assert [s.keyframe for s in sightings] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(found.position, POINT, atol=1e-5)
    assert not waiting.waiting


def test_a_wrong_sighting_is_left_out() -> None:
    poses = along(np.array((0.0, 0.3, 0.6, 0.9, 1.2)))
    pixels = pixels_of(poses)
    pixels[2] += (60.0, -40.0)
    waiting = NewPoints(MODEL)
    for k, pixel in enumerate(pixels):
        waiting.add(7, seen_at(k, pixel))
    ((_, found, sightings),) = waiting.ready([7], places(poses))
    assert [s.keyframe for s in sightings] == [0, 1, 3, 4]
    np.testing.assert_allclose(found.position, POINT, atol=1e-5)


def test_sightings_that_contradict_each_other_wait() -> None:
    rng = np.random.default_rng(22)
    poses = along(np.array((0.0, 0.4, 0.8)))
    waiting = NewPoints(MODEL)
    for k in range(3):
        waiting.add("a", seen_at(k, rng.uniform((0.0, 0.0), (640.0, 480.0))))
    assert waiting.ready(["a"], places(poses)) == []


def test_poses_that_are_not_well_known_widen_the_gate() -> None:
    poses = along(np.array((0.0, 0.7, 1.4, 2.1)))
    pixels = pixels_of(poses)
    off = poses + np.array((0.0, 0.0, 0.01)) * np.array((0, 1, -1, 1))[:, None]
    for slack, count in ((0.0, 0), (6.0, 1)):
        waiting = NewPoints(MODEL)
        for k, pixel in enumerate(pixels):
            waiting.add("a", seen_at(k, pixel))
        found = waiting.ready(["a"], places(off, slack))
        assert len(found) == count
        if found:
            assert len(found[0][2]) == 4


def test_sightings_from_keyframes_that_are_gone_do_not_count() -> None:
    poses = along(np.array((0.0, 0.5, 1.0)))
    waiting = NewPoints(MODEL)
    for k, pixel in enumerate(pixels_of(poses)):
        waiting.add("a", seen_at(k, pixel))
    assert waiting.ready(["a"], lambda k: KeyframeCamera.of(MODEL, poses[k], 0.0) if k else None) == []


def test_what_waits_is_bounded() -> None:
    waiting = NewPoints(MODEL)
    for k in range(40):
        waiting.add("always", seen_at(k, np.zeros(2)))
    assert waiting.count("always") == MAX_WAITING
    waiting.add("once", seen_at(0, np.zeros(2)))
    waiting.forget(40)
    assert waiting.count("once") == 0
    assert waiting.count("always") >= FEWEST


def test_rays_of_two_images_meet_at_the_depth_of_their_point() -> None:
    points = np.array(((3.0, 0.8, 1.0), (6.0, 2.0, 0.4), (2.0, 0.3, 1.2)))
    motion = np.array((0.3, 0.04, 0.12))
    seen = [predict(MODEL, pose, points)[0] for pose in (np.zeros(3), motion)]
    before, after = (rays(MODEL, pixels) @ MODEL.rotation.T for pixels in seen)
    depths = 1.0 / inverse_depths(before, after, MODEL.position, motion)
    np.testing.assert_allclose(depths, predict(MODEL, np.zeros(3), points)[1], rtol=1e-6)
    behind = inverse_depths(-before, -after, MODEL.position, motion)
    np.testing.assert_allclose(1.0 / behind, -depths, rtol=1e-6)
