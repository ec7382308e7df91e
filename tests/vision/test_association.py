"""Features against a map of points: with a prediction, with many wrong matches, behind walls, and without a prediction."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factorgraph_loc import CameraFrame, PointMap
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.vision.association import Associator
from factorgraph_loc.vision.consensus import CameraPose, agreeing, are_compatible
from factorgraph_loc.vision.relocalization import found_on_floor, located
from factors import se2
from factors.camera import model as reprojection

CAMERA = CameraSettings(
    fx=500.0, fy=500.0, cx=319.5, cy=239.5, distortion=(-0.1, 0.01, 0.001, -0.001), x=0.15, z=0.9, pitch=-0.05
)
MODEL = CAMERA.model()
POSE = np.array((0.4, -0.3, 0.5))
HERE = reprojection.camera_pose(MODEL, POSE)


def wall_points(rng, count=400):
    """On the walls of a room of 8 by 8 m."""
    along, height = rng.uniform(-4.0, 4.0, count), rng.uniform(0.2, 2.5, count)
    wall = np.arange(count) % 4
    x = np.choose(wall, (along, along, np.full(count, 4.0), np.full(count, -4.0)))
    y = np.choose(wall, (np.full(count, 4.0), np.full(count, -4.0), along, along))
    return np.column_stack((x, y, height))


def mapped(rng, positions, binary=False, views=3):
    """Each seen from about the middle of the room; its views differ in a few bits, or by some noise."""
    owners = np.repeat(np.arange(len(positions)), views)
    seen_from = np.column_stack((rng.uniform(-1.0, 1.0, (len(owners), 2)), np.full(len(owners), 0.9)))
    if binary:
        looks = rng.integers(0, 256, (len(positions), 32), dtype=np.uint8)[owners]
        descriptors = looks ^ (rng.random(looks.shape) < 0.1).astype(np.uint8)
    else:
        looks = rng.standard_normal((len(positions), 64))[owners]
        descriptors = (looks + 0.2 * rng.standard_normal(looks.shape)).astype(np.float32)
    return PointMap(
        tuple(f"p{i}" for i in range(len(positions))),
        positions,
        np.zeros((len(positions), 3, 3)),
        "orb" if binary else "colour",
        owners,
        descriptors,
        seen_from,
        np.full(len(owners), 5.0),
    )


def picture(rng, points, pose=POSE, wrong=0.0, clutter=60):
    """A frame from ``pose``, and which point each feature shows (-1: none); a share look like other points in view."""
    pixels, depths = reprojection.predict(MODEL, pose, points.positions)
    rows = rng.permutation(np.flatnonzero(MODEL.contains(pixels) & (depths > 0.3)))
    pixels = pixels[rows] + rng.standard_normal((len(rows), 2))
    looks = points.descriptors[np.searchsorted(points.owners, rows)].copy()
    swapped = np.arange(int(wrong * len(rows)))
    looks[swapped] = looks[np.roll(swapped, 1)]
    shown = np.concatenate((rows, np.full(clutter, -1)))
    pixels = np.concatenate((pixels, rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (clutter, 2))))
    if points.feature == "orb":
        looks = np.concatenate((looks, rng.integers(0, 256, (clutter, 32), dtype=np.uint8)))
    else:
        looks = np.concatenate((looks, rng.standard_normal((clutter, 64)).astype(np.float32)))
    tracks = np.arange(len(shown))
    return CameraFrame(0.0, points.feature, pixels, np.full(len(shown), 5.0), looks, tracks), shown


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
    points = mapped(rng, wall_points(rng), binary)
    associator, covariance = Associator(points, MODEL), spread(turn, shift)
    for _ in range(5):
        frame, shown = picture(rng, points, wrong=wrong)
        found = associator.guided(frame, *predicted(rng, covariance), covariance)
        assert np.mean(shown[found.features] == found.points) >= (0.98 if wrong else 1.0)
        assert len(found) > (0.5 if wrong else 0.85) * np.count_nonzero(shown >= 0)
        assert wrong or found.expected >= len(found)


def test_points_that_were_seen_from_elsewhere_are_not_looked_for():
    """Those of the next room lie in the image too, but the wall hides them: no view of them comes from here."""
    rng = np.random.default_rng(3)
    here, there = wall_points(rng), wall_points(rng) + np.array((8.5, 0.0, 0.0))
    points = mapped(rng, np.concatenate((here, there)))
    beyond = points.owners >= len(here)
    # there they were seen from the middle of that room, and from the side that looks away from here
    seen_from = np.where(beyond[:, None], points.seen_from + np.array((11.0, 0.0, 0.0)), points.seen_from)
    points = replace(points, seen_from=seen_from)
    frame, shown = picture(rng, points)
    frame = replace(frame, pixels=frame.pixels[shown < len(here)], descriptors=frame.descriptors[shown < len(here)])
    found = Associator(points, MODEL).guided(frame, *HERE, spread(0.01, 0.03))
    assert len(found) > 20
    assert np.all(found.points < len(here))
    near = Associator(mapped(np.random.default_rng(3), here), MODEL).guided(frame, *HERE, spread(0.01, 0.03))
    assert found.expected < 1.3 * near.expected


def test_nothing_in_an_image_or_of_another_kind_is_nothing():
    rng = np.random.default_rng(4)
    points = mapped(rng, wall_points(rng))
    associator = Associator(points, MODEL)
    frame, _ = picture(rng, points)
    empty = replace(frame, pixels=np.empty((0, 2)), descriptors=np.empty((0, 64), np.float32))
    assert len(associator.guided(empty, *HERE, spread(0.01, 0.03))) == 0
    assert associator.relocalized(empty) is None
    assert len(associator.guided(replace(frame, feature="sift"), *HERE, spread(0.01, 0.03))) == 0
    # far from the room, and looking away
    assert len(associator.guided(frame, np.array((100.0, 0.0, 1.0)), HERE[1], spread(0.01, 0.03))) == 0


def test_clutter_alone_matches_nothing():
    rng = np.random.default_rng(5)
    points = mapped(rng, wall_points(rng))
    associator = Associator(points, MODEL)
    frame, shown = picture(rng, points, clutter=300)
    only = shown < 0
    frame = replace(frame, pixels=frame.pixels[only], descriptors=frame.descriptors[only])
    assert len(associator.guided(frame, *HERE, spread(0.02, 0.05))) <= 3
    assert associator.relocalized(frame) is None


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("wrong", [0.0, 0.4])
def test_a_camera_is_found_in_the_map_without_a_prediction(binary, wrong):
    rng = np.random.default_rng(6)
    points = mapped(rng, wall_points(rng), binary)
    frame, shown = picture(rng, points, wrong=wrong)
    position, rotation, covariance, seen = Associator(points, MODEL).relocalized(frame)
    assert np.mean(shown[seen.features] == seen.points) > 0.98
    turn = gtsam.Rot3.Logmap(gtsam.Rot3(HERE[1].T @ rotation))
    error = np.concatenate((turn, HERE[1].T @ (position - HERE[0])))
    # six degrees of freedom, a bound with 1e-5 of false alarms
    assert error @ np.linalg.solve(covariance, error) < 34.0


def named(rng, count, wrong):
    """Points in view from POSE, with a share of them at pixels that mean nothing."""
    positions = wall_points(rng, 40 * count)
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
    points = mapped(rng, wall_points(rng, 3000))
    covariance = spread(0.01, 0.03)
    frame, shown = picture(rng, points, clutter=0)
    strange = np.arange(len(shown)) >= max(4, int(kept * len(shown)))
    descriptors = np.where(strange[:, None], rng.standard_normal(frame.descriptors.shape), frame.descriptors)
    frame = replace(frame, descriptors=descriptors.astype(np.float32))
    found = Associator(points, MODEL).guided(frame, *predicted(rng, covariance), covariance)
    assert found.expected > 400
    assert (len(found) > 0) == believed
    assert found.rejected >= 4 or believed
