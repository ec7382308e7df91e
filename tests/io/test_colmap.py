"""Models of COLMAP as text."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorgraph_loc.errors import InputError
from factorgraph_loc.io.colmap import ColmapModel, read_colmap, write_colmap
from factors.camera.model import CameraModel

# as COLMAP writes it: comments, an image without points, features that show no point, numbers that skip some
CAMERAS = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
3 SIMPLE_RADIAL 640 480 500.0 320.5 240.5 0.01
"""
IMAGES = """# Image list with two lines of data per image:
4 0.7071067811865476 0 0 0.7071067811865476 1 2 3 3 a b.jpg
10.5 20.5 7 11.5 21.5 -1 12.5 22.5 9
6 1 0 0 0 0 0 0 3 second.jpg

"""
POINTS = """# 3D point list
7 1.0 2.0 3.0 255 0 0 0.5 4 0
9 4.0 5.0 6.0 255 0 0 0.5 4 2
"""


def written(tmp_path, **files):
    content = {"cameras": CAMERAS, "images": IMAGES, "points3D": POINTS} | files
    for name, text in content.items():
        (tmp_path / f"{name}.txt").write_text(text)
    return tmp_path


def test_what_colmap_writes(tmp_path):
    model = read_colmap(written(tmp_path))
    assert model.names == ("a b.jpg", "second.jpg")
    assert model.sizes == ((640, 480),) * 2
    # it has the world in the camera: x of the world is y of the camera
    np.testing.assert_allclose(model.rotations[0].T @ (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(model.rotations[0].T @ (np.zeros(3) - model.positions[0]), (1.0, 2.0, 3.0))
    np.testing.assert_array_equal(model.seen_in, (0, 0))
    np.testing.assert_array_equal(model.seen, (0, 1))
    np.testing.assert_allclose(model.pixels, ((10.0, 20.0), (12.0, 22.0)))
    np.testing.assert_allclose(model.points[1], (4.0, 5.0, 6.0))


def test_what_is_written_is_read(tmp_path):
    rng = np.random.default_rng(0)
    camera = CameraModel(fx=500.0, fy=510.0, cx=320.0, cy=240.0, width=640, height=480)
    rotations = Rotation.random(3, random_state=1).as_matrix()
    seen_in, seen = np.array((0, 0, 2)), np.array((1, 0, 1))
    model = ColmapModel(
        ((640, 480),) * 3,
        ("a.jpg", "b.jpg", "c.jpg"),
        rng.standard_normal((3, 3)),
        rotations,
        rng.standard_normal((2, 3)),
        seen_in,
        seen,
        rng.uniform(0.0, 400.0, (3, 2)),
    )
    write_colmap(model, camera, tmp_path / "model")
    found = read_colmap(tmp_path / "model")
    assert found.names == model.names
    for name in ("positions", "rotations", "points", "seen_in", "seen", "pixels"):
        np.testing.assert_allclose(getattr(found, name), getattr(model, name), rtol=1e-6, atol=1e-6)
    assert (tmp_path / "model" / "cameras.txt").read_text() == "1 OPENCV 640 480 500 510 320.5 240.5 0 0 0 0\n"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("points3D", "7 1.0 two 3.0 0 0 0 1\n", r"points3D\.txt:1: field is 'two', expected a finite number"),
        ("points3D", "", "has 2 images and 0 points"),
        ("images", IMAGES.replace(" 7 ", " 7.5 "), r"images\.txt:3: field is '7\.5', expected an integer"),
        ("images", "4 1 0 0 0 0 0 0 3\n", r"images\.txt:1: row is .*, expected 10 fields"),
        ("images", IMAGES.replace("1 0 0 0 0 0 0 3", "0 0 0 0 0 0 0 3"), "the quaternion of second.jpg is 0"),
        ("images", IMAGES.replace(" 3 second", " 5 second"), "camera is '5', expected one of those in cameras.txt"),
        ("cameras", "3 PINHOLE 640\n", r"cameras\.txt:1: row is '3 PINHOLE 640', expected 4 fields"),
    ],
)
def test_models_that_are_none(tmp_path, name, text, message):
    with pytest.raises(InputError, match=message):
        read_colmap(written(tmp_path, **{name: text}))
