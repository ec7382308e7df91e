"""The images of a drive: the same for the same seed, of the same world for another drive, and good for finding features in."""

import cv2
import numpy as np
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.simulation import film, preset, simulate, with_images
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
