"""The images of a drive: the same for the same seed, of the same world for another drive, and good for finding features in."""

import cv2
import numpy as np
import pytest

from factorgraph_loc import InputError, PointMap, World
from factorgraph_loc.maps.free_space import distance_to_walls
from factorgraph_loc.sensors.camera.settings import PixelSettings
from factorgraph_loc.sensors.camera.simulation import pixel_stream, surface_normals
from factorgraph_loc.simulation import film, preset, simulate, with_images
from factorgraph_loc.simulation.worlds import STANDOFF
from factors.camera import model as reprojection

SETTINGS = {"drive": {"duration": 8.0}, "world": {"tags": 12, "width": 9.0, "depth": 8.0}, "images": {"rate": 2.5}}


@pytest.fixture(scope="module")
def made():
    return film(preset("office", SETTINGS), 1)


def test_images_stand_at_their_times_and_poses(made):
    log = simulate(preset("office", SETTINGS), 1)
    assert len(made) == 20
    np.testing.assert_allclose(made.times, np.arange(1, 21) / 2.5)
    assert made.truth.poses.tobytes() == log.reference.poses.tobytes()
    stamp, image = next(iter(made))
    assert stamp == pytest.approx(0.4)
    assert image.shape == (480, 640, 3)
    assert image.dtype == np.uint8


def test_the_same_seed_gives_the_same_images_in_any_order(made):
    again = film(preset("office", SETTINGS), 1)
    for i in (3, 0, 3):
        assert again[i].tobytes() == made[i].tobytes()
    assert made[0].tobytes() != made[1].tobytes()


def test_two_drives_through_one_world_see_the_same_building(made):
    other = film(preset("office", {**SETTINGS, "world_seed": 1}), 2)
    assert other.renderer.scene.texels.tobytes() == made.renderer.scene.texels.tobytes()
    assert other.truth.poses.tobytes() != made.truth.poses.tobytes()
    elsewhere = film(preset("office", {**SETTINGS, "world_seed": 2}), 2)
    assert elsewhere.renderer.scene.texels.tobytes() != made.renderer.scene.texels.tobytes()


def test_brightness_wanders(made):
    """By as much as three waves of the drift's size can."""
    gains = [made._gain(t) for t in np.linspace(0.0, 300.0, 400)]
    assert 1.1 < max(gains) < np.exp(0.3)
    assert np.exp(-0.3) < min(gains) < 0.9
    assert np.abs(np.diff(gains)).max() < 0.15


def sift(image):
    keypoints, descriptors = cv2.SIFT_create(400).detectAndCompute(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), None)
    return np.array([k.pt for k in keypoints]).reshape(-1, 2), descriptors


def test_features_that_match_show_the_same_point(made):
    """Images 0.8 s apart. What does not fit is wrongly matched: books and letters look alike."""
    model, errors = made.renderer.model, []
    for i in range(0, 18, 3):
        (first, a), (second, b) = sift(made[i]), sift(made[i + 2])
        pairs = [m for m, n in cv2.BFMatcher().knnMatch(a, b, k=2) if m.distance < 0.7 * n.distance]
        before, after = made.truth.at(made.times[[i, i + 2]])
        points = made.renderer.hits(first[[m.queryIdx for m in pairs]], *reprojection.camera_pose(model, before))
        seen, _ = reprojection.predict(model, after, points)
        errors.append(np.hypot(*(seen - second[[m.trainIdx for m in pairs]]).T))
    pooled = np.concatenate(errors)
    assert len(pooled) > 200
    assert np.median(pooled) < 0.5
    assert (pooled < 2.0).mean() > 0.8


def test_a_log_gets_its_images(tmp_path, made):
    settings = preset("office", {**SETTINGS, "rig": {"camera": {"time_offset": 0.05}}})
    progress = []
    log = with_images(simulate(settings, 1), settings, 1, tmp_path, progress=lambda *done: progress.append(done))
    stream = log.streams["camera"]
    assert log.rig.sensors == ("odometry", "rfid", "camera")
    np.testing.assert_allclose(stream.t, made.times - 0.05)
    assert progress[-1] == (20, 20)
    for i in (0, 19):
        read = cv2.imread(str(stream.file[i])).astype(float)
        assert np.abs(read - made[i]).mean() < 4.0  # what the file's compression takes


def test_several_processes_write_the_same_files(tmp_path, monkeypatch):
    monkeypatch.setattr("factorgraph_loc.simulation.filming.FEW", 0)
    settings = preset("office", {**SETTINGS, "drive": {"duration": 1.2}})
    log = simulate(settings, 1)
    folders = [tmp_path / name for name in ("one", "two")]
    for workers, folder in enumerate(folders, start=1):
        folder.mkdir()
        with_images(log, settings, 1, folder, workers=workers)
    contents = [{file.name: file.read_bytes() for file in folder.iterdir()} for folder in folders]
    assert len(contents[0]) == 3
    assert contents[0] == contents[1]


def test_a_rig_without_a_camera_takes_no_images():
    with pytest.raises(InputError, match="has no camera"):
        film(preset("office", {"rig": {"camera": None}}), 0)


def test_a_camera_above_furniture_takes_no_images():
    with pytest.raises(InputError, match=r"camera\.z is 1\.5, expected at most 1\.4 m"):
        film(preset("office", {"rig": {"camera": {"z": 1.5}}}), 0)


@pytest.fixture(scope="module")
def seen(make):
    return make(2, world={"points": 800})


def test_points_are_named_and_lie_on_surfaces(seen):
    points = seen.world.points
    assert points.names[:2] == ("P0000", "P0001")
    assert len(points) == 800
    distance = distance_to_walls(seen.world, points.positions[:, :2])
    assert distance.max() < STANDOFF + 2e-3
    # a few beside the corner of a wall and a cupboard are nearer to that
    assert (distance > STANDOFF - 2e-3).mean() > 0.98
    z = points.positions[:, 2]
    assert z.min() < 0.4
    assert z.max() > 2.1
    assert ((z >= 0.3) & (z <= 2.2)).all()


def test_points_change_nothing_else(make, seen):
    plain = make(2)
    assert plain.world.points is None
    assert plain.rig.sensors == ("odometry", "rfid")
    assert seen.rig.sensors == ("odometry", "rfid", "sightings")
    assert plain.world.tags == seen.world.tags
    assert plain.reference.poses.tobytes() == seen.reference.poses.tobytes()
    assert repr(plain.streams["rfid"]) == repr(seen.streams["rfid"])


def test_pixels_err_as_the_rig_says(seen):
    """Mean and variance within five standard errors."""
    stream, model = seen.streams["sightings"], seen.rig.camera.model()
    rows = [seen.world.points.index[name] for name in stream.point]
    positions = seen.world.points.positions[rows]
    poses = seen.reference.at(stream.t)
    expected = [reprojection.predict(model, pose, p[None]) for pose, p in zip(poses, positions, strict=True)]
    pixels = np.concatenate([uv for uv, _ in expected])
    depths = np.concatenate([depth for _, depth in expected])
    errors = (np.column_stack((stream.u, stream.v)) - pixels) / model.sigma
    assert len(errors) > 1000
    assert (np.abs(errors.mean(axis=0)) < 5.0 / np.sqrt(len(errors))).all()
    assert (np.abs(errors.var(axis=0) - 1.0) < 5.0 * np.sqrt(2.0 / len(errors))).all()
    assert model.contains(pixels).all()
    assert ((depths >= 0.3) & (depths <= 10.0)).all()
    assert np.unique(stream.t, return_counts=True)[1].max() == 20


def test_what_is_behind_a_wall_or_edge_on_or_out_of_view_is_not_seen(seen):
    walls = ((3.0, -1.0, 3.0, 1.0), (5.0, -4.0, 5.0, 4.0), (0.0, 1.5, 9.0, 1.5))
    places = {
        "before": (2.98, 0.5, 1.0),
        "other side": (3.02, 0.5, 1.0),
        "behind": (4.98, 0.0, 1.0),
        "beside": (4.98, -2.0, 1.0),
        "oblique": (8.0, 1.48, 1.0),
        "too high": (2.98, 0.0, 4.0),
        "back": (-2.0, 1.48, 1.0),
    }
    world = World(points=PointMap.of(list(places), np.array(list(places.values()))), walls=walls)
    model = seen.rig.camera.model()
    stream = pixel_stream(model, world, np.ones(1), np.zeros((1, 3)), PixelSettings(), np.random.default_rng(0))
    assert list(stream.point) == ["before", "beside"]
    np.testing.assert_allclose(surface_normals(world, np.array(((3.1, 0.0), (2.9, 0.0)))), ((1.0, 0.0), (-1.0, 0.0)))


def test_a_share_of_wrong_points_is_far_off(make):
    log = make(1, world={"points": 300}, pixels={"wrong": 0.4, "rate": 2.0})
    stream, model = log.streams["sightings"], log.rig.camera.model()
    rows = [log.world.points.index[name] for name in stream.point]
    far = []
    for t, p, u, v in zip(stream.t, log.world.points.positions[rows], stream.u, stream.v, strict=True):
        uv, _ = reprojection.predict(model, log.reference.at(np.array((t,)))[0], p[None])
        far.append(np.hypot(*(uv[0] - (u, v))) > 6.0 * model.sigma)
    # six standard deviations of the share
    assert abs(np.mean(far) - 0.4) < 6.0 * np.sqrt(0.24 / len(far)) + 0.01


def test_stamps_are_by_the_clock_of_the_camera(make):
    plain = make(0, world={"points": 50}).streams["sightings"]
    late = make(0, world={"points": 50}, rig={"camera": {"time_offset": 0.1}})
    np.testing.assert_allclose(late.streams["sightings"].t, plain.t - 0.1, atol=1e-9)
    assert next(late.measurements(("sightings",))).t == pytest.approx(plain.t[0])


def test_drives_of_two_seeds_through_one_world(make):
    first, second = (make(seed, world_seed=7, world={"points": 20}, faults={"misplaced": 0.2}) for seed in (1, 2))
    assert first.world == second.world
    assert first.world == make(7, world={"points": 20}, faults={"misplaced": 0.2}).world
    assert first.reference.poses.tobytes() != second.reference.poses.tobytes()
    assert first.metadata["world_seed"] == "7"


def test_points_need_a_camera():
    with pytest.raises(InputError, match="expected a rig with a camera"):
        preset("warehouse", {"world": {"points": 3}, "rig": {"camera": None}})
