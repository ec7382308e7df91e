"""Features against a map of points: with a prediction, with many wrong matches, behind walls, and without a prediction."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from camera_world import CAMERA, frame, on_walls, pointed, room, with_views

from factorgraph_loc.vision.association import Associator
from factorgraph_loc.vision.consensus import CameraPose, agreeing, are_compatible
from factorgraph_loc.vision.relocalization import found_on_floor, located
from factors import se2
from factors.camera import model as reprojection

MODEL = CAMERA.model()
POSE = np.array((0.4, -0.3, 0.5))
HERE = reprojection.camera_pose(MODEL, POSE)


def spread(turn, shift):
    """A prediction's covariance: standard deviations of the camera's turn [rad] and shift [m]."""
    return np.diag(np.repeat((turn, shift), 3)) ** 2


def predicted(rng, covariance):
    """A camera drawn from the prediction."""
    step = np.linalg.cholesky(covariance) @ rng.standard_normal(6)
    turn = np.asarray(gtsam.Rot3.Expmap(step[:3]).matrix())
    return HERE[0] + HERE[1] @ step[3:], HERE[1] @ turn


@pytest.mark.parametrize(("binary", "wrong"), [(False, 0.0), (True, 0.0), (False, 0.4)])
@pytest.mark.parametrize(("turn", "shift"), [(0.01, 0.03), (0.05, 0.15)])
def test_what_is_seen_is_found_near_its_prediction_and_what_looks_like_others_is_left_out(binary, wrong, turn, shift):
    rng = np.random.default_rng(1)
    points = with_views(room(400), binary=binary)
    associator, covariance = Associator(points, MODEL), spread(turn, shift)
    for _ in range(5):
        image, shown = frame(points, POSE, 0.0, rng, wrong=wrong)
        found = associator.guided(image, CameraPose(*predicted(rng, covariance), covariance))
        assert np.mean(shown[found.features] == found.points) >= (0.98 if wrong else 1.0)
        assert len(found) > (0.5 if wrong else 0.85) * np.count_nonzero(shown >= 0)
        assert wrong or found.expected >= len(found)


def test_points_that_were_seen_from_elsewhere_are_not_looked_for():
    """Those of the next room lie in the image too, but the wall hides them: no view of them comes from here."""
    rng = np.random.default_rng(3)
    here, there = on_walls(rng, 400), on_walls(rng, 400) + np.array((8.5, 0.0, 0.0))
    points = with_views(pointed(np.concatenate((here, there))))
    beyond = points.owners >= len(here)
    # there they were seen from the middle of that room, and from the side that looks away from here
    seen_from = np.where(beyond[:, None], points.seen_from + np.array((11.0, 0.0, 0.0)), points.seen_from)
    points = replace(points, seen_from=seen_from)
    image, shown = frame(points, POSE, 0.0, rng)
    image = replace(image, pixels=image.pixels[shown < len(here)], descriptors=image.descriptors[shown < len(here)])
    found = Associator(points, MODEL).guided(image, CameraPose(*HERE, spread(0.01, 0.03)))
    assert len(found) > 20
    assert np.all(found.points < len(here))
    near = Associator(with_views(pointed(here)), MODEL).guided(image, CameraPose(*HERE, spread(0.01, 0.03)))
    assert found.expected < 1.3 * near.expected


def test_nothing_in_an_image_or_of_another_kind_is_nothing():
    rng = np.random.default_rng(4)
    points = with_views(room(400))
    associator = Associator(points, MODEL)
    image, _ = frame(points, POSE, 0.0, rng)
    empty = replace(image, pixels=np.empty((0, 2)), descriptors=np.empty((0, 64), np.float32))
    assert len(associator.guided(empty, CameraPose(*HERE, spread(0.01, 0.03)))) == 0
    assert associator.relocalized(empty) is None
    assert len(associator.guided(replace(image, feature="sift"), CameraPose(*HERE, spread(0.01, 0.03)))) == 0
    # far from the room, and looking away
    away = CameraPose(np.array((100.0, 0.0, 1.0)), HERE[1], spread(0.01, 0.03))
    assert len(associator.guided(image, away)) == 0


def test_clutter_alone_matches_nothing():
    rng = np.random.default_rng(5)
    points = with_views(room(400))
    associator = Associator(points, MODEL)
    image, shown = frame(points, POSE, 0.0, rng, clutter=300)
    only = shown < 0
    image = replace(image, pixels=image.pixels[only], descriptors=image.descriptors[only])
    assert len(associator.guided(image, CameraPose(*HERE, spread(0.02, 0.05)))) <= 3
    assert associator.relocalized(image) is None


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("wrong", [0.0, 0.4])
def test_a_camera_is_found_in_the_map_without_a_prediction(binary, wrong):
    rng = np.random.default_rng(6)
    points = with_views(room(400), binary=binary)
    image, shown = frame(points, POSE, 0.0, rng, wrong=wrong)
    camera, seen = Associator(points, MODEL).relocalized(image)
    assert np.mean(shown[seen.features] == seen.points) > 0.98
    turn = gtsam.Rot3.Logmap(gtsam.Rot3(HERE[1].T @ camera.rotation))
    error = np.concatenate((turn, HERE[1].T @ (camera.position - HERE[0])))
    # six degrees of freedom, a bound with 1e-5 of false alarms
    assert error @ np.linalg.solve(camera.covariance, error) < 34.0


def named(rng, count, wrong):
    """Points in view from POSE, with a share of them at pixels that mean nothing."""
    positions = on_walls(rng, 40 * count)
    pixels, depths = reprojection.predict(MODEL, POSE, positions)
    rows = np.flatnonzero(MODEL.contains(pixels) & (depths > 0.3))[:count]
    pixels = pixels[rows] + rng.standard_normal((len(rows), 2))
    bad = np.arange(len(rows)) < round(wrong * len(rows))
    pixels[bad] = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (np.count_nonzero(bad), 2))
    return positions[rows], pixels, bad


@pytest.mark.parametrize("wrong", [0.0, 0.4, 0.6])
def test_a_robot_on_the_floor_is_found_by_named_points(wrong):
    for seed in range(10):
        points, pixels, bad = named(np.random.default_rng(seed), 20, wrong)
        found = found_on_floor(MODEL, points, pixels)
        assert found is not None
        error = se2.log(se2.between(POSE, found.pose))
        # three degrees of freedom, a bound with 1e-5 of false alarms
        assert error @ np.linalg.solve(found.covariance, error) < 25.9
        assert np.count_nonzero(found.inliers & bad) == 0


def test_a_robot_that_would_float_is_not_believed():
    points, pixels, _ = named(np.random.default_rng(1), 20, 0.0)
    assert found_on_floor(MODEL, points + np.array((0.0, 0.0, 1.0)), pixels) is None
    assert found_on_floor(MODEL, points[:3], pixels[:3]) is None
    # nothing can be told from points at one place
    assert found_on_floor(MODEL, np.repeat(points[:1], 6, axis=0), np.repeat(pixels[:1], 6, axis=0)) is None
    # three points at pixels that mean nothing are seen from somewhere, and a fourth or fifth by chance
    chance = located(MODEL, points, np.random.default_rng(2).uniform(0, 480, pixels.shape))
    assert chance is None or np.count_nonzero(chance.inliers) <= 5


def test_all_that_agree_with_a_prediction_are_taken_together():
    rng = np.random.default_rng(7)
    noise = np.broadcast_to(np.eye(2), (20, 2, 2))
    kept = 0
    for _ in range(200):
        points, pixels, _ = named(rng, 20, 0.0)
        covariance = spread(0.001, 0.003)
        camera = CameraPose(*predicted(rng, covariance), covariance)
        kept += are_compatible(MODEL, camera, points, pixels, noise)
    assert kept >= 190  # of 198 expected: below 1e-4 of false alarms


@pytest.mark.parametrize("rank", [3, 6])
def test_those_that_do_not_agree_are_told_apart(rank):
    """Also where the prediction is sure that the robot stays on the floor."""
    rng = np.random.default_rng(8)
    noise = np.broadcast_to(np.eye(2), (20, 2, 2))
    for _ in range(20):
        points, pixels, bad = named(rng, 20, 0.4)
        covariance = spread(0.05, 0.2)
        position, rotation = predicted(rng, covariance) if rank == 6 else HERE
        if rank == 3:
            lift = np.zeros((6, 3))
            lift[:3, 2], lift[3:, :2] = MODEL.rotation[2], MODEL.rotation[:2].T
            covariance = lift @ np.diag((0.2, 0.2, 0.05)) ** 2 @ lift.T
        right = agreeing(MODEL, CameraPose(position, rotation, covariance), points, pixels, noise)
        assert np.count_nonzero(right & bad) == 0
        assert np.count_nonzero(right & ~bad) >= 11  # of 12


def test_garbage_agrees_on_nothing():
    rng = np.random.default_rng(9)
    points, pixels, _ = named(rng, 20, 1.0)
    points[:5] = HERE[0]  # in the camera itself
    noise = np.broadcast_to(np.eye(2), (20, 2, 2))
    right = agreeing(MODEL, CameraPose(*HERE, spread(0.05, 0.2)), points, pixels, noise)
    assert np.count_nonzero(right) <= 5


@pytest.mark.parametrize(("kept", "believed"), [(0.02, False), (0.15, True)])
def test_few_that_agree_of_many_expected_are_not_believed(kept, believed):
    """As in a place that the map does not know, where a few agree by chance."""
    rng = np.random.default_rng(8)
    points = with_views(room(3000))
    covariance = spread(0.01, 0.03)
    image, shown = frame(points, POSE, 0.0, rng, clutter=0, limit=1000)
    strange = np.arange(len(shown)) >= max(4, int(kept * len(shown)))
    descriptors = np.where(strange[:, None], rng.standard_normal(image.descriptors.shape), image.descriptors)
    image = replace(image, descriptors=descriptors.astype(np.float32))
    found = Associator(points, MODEL).guided(image, CameraPose(*predicted(rng, covariance), covariance))
    assert found.expected > 400
    assert (len(found) > 0) == believed
    assert found.rejected >= 4 or believed
