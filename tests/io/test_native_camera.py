"""Images and identified pixels in the native format: what is read, refused, mended, and that what is written comes back."""

from pathlib import Path

import numpy as np
import pytest

from factorgraph_loc import ImageStream, InputError, SightingStream, write_native

CAMERA = "t_ns,file\n1100000000,a.png\n1300000000,b.png\n1500000000,c.png\n"
PIXELS = "t_ns,landmark,u,v\n1200000000,door,10.5,20\n1200000000,lamp,-3,400.25\n1400000000,door,11,21\n"


@pytest.fixture
def seen(native: Path) -> Path:
    """The small log with three images, of which nothing but the names matters here, and three identified pixels."""
    (native / "camera").mkdir()
    for name in ("a.png", "b.png", "c.png"):
        (native / "camera" / name).write_bytes(name.encode())
    (native / "camera.csv").write_text(CAMERA)
    (native / "sightings.csv").write_text(PIXELS)
    return native


def test_what_is_read(seen, one):
    log = one(seen)
    assert log.warnings == ()
    images, pixels = log.streams["camera"], log.streams["sightings"]
    assert isinstance(images, ImageStream)
    np.testing.assert_allclose(images.t, (0.1, 0.3, 0.5))
    assert [file.read_bytes() for file in images.file] == [b"a.png", b"b.png", b"c.png"]
    assert isinstance(pixels, SightingStream)
    first, second = pixels.measurements(0.0)
    assert (first.points, second.points) == (("door", "lamp"), ("door",))
    np.testing.assert_array_equal(first.pixels, ((10.5, 20.0), (-3.0, 400.25)))


@pytest.mark.parametrize("format", ["csv", "parquet"])
def test_what_is_written_comes_back(seen, one, tmp_path, format):
    log = one(seen)
    write_native(log, tmp_path / "copy", format=format)
    copy = one(tmp_path / "copy")
    np.testing.assert_array_equal(copy.streams["camera"].t, log.streams["camera"].t)
    assert [f.read_bytes() for f in copy.streams["camera"].file] == [b"a.png", b"b.png", b"c.png"]
    assert all(f.is_relative_to((tmp_path / "copy" / "camera").resolve()) for f in copy.streams["camera"].file)
    for column in ("t", "u", "v"):
        np.testing.assert_array_equal(
            getattr(copy.streams["sightings"], column), getattr(log.streams["sightings"], column)
        )
    assert copy.streams["sightings"].point == ["door", "lamp", "door"]


@pytest.mark.parametrize("name", ["hostname", "./hostname"])
def test_images_in_a_folder_that_links_outside_are_refused(seen, refused, name):
    (seen / "camera").rename(seen / "other")
    (seen / "camera").symlink_to("/etc")
    (seen / "camera.csv").write_text(f"t_ns,file\n1100000000,{name}\n")
    refused(seen, "camera.csv: path 'camera' leaves its folder")


def test_an_image_that_goes_before_it_is_written_is_an_error_and_leaves_nothing(seen, one, tmp_path):
    log = one(seen)
    (seen / "camera" / "b.png").unlink()
    with pytest.raises(InputError, match=r"b\.png: cannot be read: No such file"):
        write_native(log, tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


def test_missing_images_are_left_out_with_a_warning(seen, one):
    (seen / "camera" / "b.png").unlink()
    (seen / "camera.csv").write_text(CAMERA + f"1600000000,{'x' * 5000}\n")
    log = one(seen)
    assert [file.name for file in log.streams["camera"].file] == ["a.png", "c.png"]
    (warning,) = log.warnings
    assert str(warning).endswith("camera.csv: 2 of 4 images are missing and skipped, the first is b.png of row 3")


BAD = {
    "image outside": ("camera", "1,../../secret.png", "camera.csv:2: path", "leaves its folder"),
    "no image": ("camera", "1,", ":2: file is ''", "the name of an image"),
    "no name": ("sightings", "1,,1,2", ":2: landmark is ''", "the name of a landmark"),
}


@pytest.mark.parametrize(("sensor", "rows", "fragments"), [(s, r, f) for s, r, *f in BAD.values()], ids=list(BAD))
def test_refused(seen, refused, sensor, rows, fragments):
    header = (seen / f"{sensor}.csv").read_text().splitlines()[0]
    (seen / f"{sensor}.csv").write_text(f"{header}\n{rows}\n")
    refused(seen, *fragments)


def test_a_link_out_of_the_folder_is_refused(seen, refused, tmp_path):
    (tmp_path / "secret.png").write_bytes(b"")
    (seen / "camera" / "b.png").unlink()
    (seen / "camera" / "b.png").symlink_to(tmp_path / "secret.png")
    refused(seen, "camera.csv:3: path", "leaves its folder")
