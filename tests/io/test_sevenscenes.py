"""Folders of 7-Scenes: what is read, and what is refused."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from factorgraph_loc.io.readers import load


def write_pose(path, pose):
    path.write_text("\n".join(" ".join(f"{value:.7e}" for value in row) for row in pose) + "\n")


@pytest.fixture
def scene(tmp_path):
    """Three frames whose numbers leave gaps."""
    rng = np.random.default_rng(3)
    folder = tmp_path / "corner"
    folder.mkdir()
    for k, number in enumerate((0, 2, 10)):
        pixels = rng.integers(0, 255, (480, 640, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"frame-{number:06d}.color.jpg", quality=20)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec((0.1 * k, 0.2, -0.3)).as_matrix()
        pose[:3, 3] = (k, 2.0, 3.0)
        write_pose(folder / f"frame-{number:06d}.pose.txt", pose)
    return folder


@pytest.fixture
def refuse(refused):
    return lambda folder, *fragments: refused(folder, *fragments, reader="sevenscenes")


def test_frames_count_in_the_order_of_their_names(scene, one):
    log = one(scene, reader="sevenscenes")
    assert [file.name[6:12] for file in log.streams["camera"].file] == ["000000", "000002", "000010"]
    np.testing.assert_allclose(log.streams["camera"].t, np.arange(3) / 15.0)
    np.testing.assert_array_equal(log.reference3.t, log.streams["camera"].t)
    np.testing.assert_allclose(log.reference3.positions, [(k, 2.0, 3.0) for k in range(3)])
    expected = Rotation.from_rotvec([(0.1 * k, 0.2, -0.3) for k in range(3)]).as_matrix()
    np.testing.assert_allclose(log.reference3.rotations, expected, atol=1e-6)
    products = np.einsum("nji,njk->nik", log.reference3.rotations, log.reference3.rotations)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), (3, 3, 3)), atol=1e-12)
    assert (log.rig.camera.fx, log.rig.camera.cx, log.rig.camera.cy) == (525.0, 320.0, 240.0)
    np.testing.assert_allclose(
        log.rig.camera.model().rotation, np.eye(3), atol=1e-12
    )  # the robot's frame is the camera's
    assert log.reference is None


def test_another_nominal_rate(scene, one):
    log = one(scene, reader="sevenscenes", options={"rate": 30.0})
    np.testing.assert_allclose(log.streams["camera"].t, np.arange(3) / 30.0)


def test_poses_that_are_none(scene, refuse):
    path = scene / "frame-000002.pose.txt"
    rows = path.read_text().splitlines()
    path.write_text("\n".join(rows[:3]))
    refuse(scene, "frame-000002.pose.txt: has 3 rows")
    path.write_text("\n".join([rows[0], rows[1].rsplit(maxsplit=1)[0], *rows[2:]]))
    refuse(scene, "frame-000002.pose.txt:2", "4 numbers")
    path.write_text("\n".join([rows[0].replace(rows[0].split()[1], "x"), *rows[1:]]))
    refuse(scene, "frame-000002.pose.txt:1", "4 numbers")
    path.write_text("\n".join([rows[0].replace(rows[0].split()[1], "nan"), *rows[1:]]))
    refuse(scene, "frame-000002.pose.txt:1", "column 2", "finite")
    path.write_text("\n".join([*rows[:3], "0 0 1 1"]))
    refuse(scene, "frame-000002.pose.txt:4", "0 0 0 1")
    path.unlink()
    refuse(scene, "frame-000002.pose.txt: cannot be read")


@pytest.mark.parametrize("change", [np.diag((2.0, 1.0, 1.0)), np.diag((-1.0, 1.0, 1.0))], ids=["scaled", "mirrored"])
def test_a_rotation_that_is_none(scene, refuse, change):
    pose = np.eye(4)
    pose[:3, :3] = change
    write_pose(scene / "frame-000010.pose.txt", pose)
    refuse(scene, "frame-000010.pose.txt", "not a rotation")


def test_images_that_are_none(scene, refuse):
    path = scene / "frame-000010.color.jpg"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    refuse(scene, "frame-000010.color.jpg: ends too early")
    path.write_bytes(b"")
    refuse(scene, "frame-000010.color.jpg: is not an image")
    Image.new("RGB", (320, 240)).save(path)
    refuse(scene, "frame-000010.color.jpg", "320 x 240", "640 x 480")


def test_a_folder_without_frames(tmp_path, refuse):
    (tmp_path / "empty").mkdir()
    refuse(tmp_path / "empty", "contains no images")


def test_the_recording(data_root):
    if not (data_root / "sevenscenes").is_dir():
        pytest.skip("the folder of recorded data has no sevenscenes")
    (log,) = load("sevenscenes", data_root=data_root)
    assert len(log.streams["camera"].t) == len(log.reference3) == 300
    assert np.linalg.norm(np.diff(log.reference3.positions, axis=0), axis=1).max() < 0.1  # m between frames
