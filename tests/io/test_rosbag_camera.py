"""Images of a bag, the lens of its camera and where it sits."""

import math
import tracemalloc

import cv2
import numpy as np
import pytest
from rosbag_drive import MS, T0, add_frames, transform

from factors.camera.model import mounting


def add_image(made, t_ns, pixels, encoding, padding=0, kind=np.uint8, topic="/camera/image_raw"):
    rows = np.ascontiguousarray(pixels.astype(kind)).reshape(len(pixels), -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    made.stamped(
        topic,
        t_ns,
        "sensor_msgs/msg/Image",
        frame="camera",
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=rows.shape[1],
        data=rows.ravel(),
    )


def test_images_without_loss(maker, read_drive, one):
    rng = np.random.default_rng(0)
    colour, grey = rng.integers(0, 256, (20, 30, 3)), rng.integers(0, 256, (20, 30))
    deep = rng.integers(0, 65536, (20, 30))
    add_image(maker, T0, colour, "rgb8", padding=6)
    add_image(maker, T0 + 100 * MS, colour, "bgr8")
    add_image(maker, T0 + 200 * MS, grey, "mono8", padding=2)
    add_image(maker, T0 + 300 * MS, deep, "mono16", kind=np.uint16)
    add_image(maker, T0 + 400 * MS, np.dstack((colour, grey)), "bgra8")
    images = read_drive(maker, camera={"topic": "/camera/image_raw"}).streams["camera"]
    np.testing.assert_allclose(images.t, 0.1 * np.arange(5), atol=1e-9)
    found = [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in images.file]
    for image, expected in zip(found, (colour[:, :, ::-1], colour, grey, deep, colour), strict=True):
        np.testing.assert_array_equal(image, expected)
    before = [file.stat().st_mtime_ns for file in images.file]
    options = {"odometry": {"topic": "/odom"}, "camera": {"topic": "/camera/image_raw"}}
    log = one(maker.path, reader="rosbag", options=options)
    assert "/camera/image_raw 0.000 s" in log.metadata["clock"]  # is known without the messages
    again = log.streams["camera"]
    assert (again.file, again.t.tolist()) == (images.file, images.t.tolist())
    assert [file.stat().st_mtime_ns for file in again.file] == before  # were not written again
    images.file[2].unlink()
    assert one(maker.path, reader="rosbag", options=options).streams["camera"].file[2].is_file()


def test_a_bayer_pattern_becomes_colour(maker, read_drive):
    mosaic = np.zeros((20, 30))
    mosaic[::2, ::2] = 200.0  # red lies at even rows and columns
    add_image(maker, T0, mosaic, "bayer_rggb8")
    (file,) = read_drive(maker, camera={"topic": "/camera/image_raw"}).streams["camera"].file
    blue, green, red = cv2.imread(str(file))[10, 10]
    assert (blue, green, red) == (0, 0, 200)


def test_an_image_with_too_few_bytes(maker, refuse_drive, tmp_path):
    pixels = np.zeros((4, 4, 1))
    maker.stamped(
        "/camera/image_raw",
        T0,
        "sensor_msgs/msg/Image",
        height=5,
        width=4,
        encoding="mono8",
        is_bigendian=0,
        step=4,
        data=pixels.astype(np.uint8).ravel(),
    )
    refuse_drive(maker, "image_raw:1: has 16 bytes, expected 5 rows of 4", camera={"topic": "/camera/image_raw"})
    assert not list((tmp_path / "cache" / "bags").iterdir())


def add_info(made, kind="plumb_bob", **changes):
    upper = str.upper if made.ros1 else str
    lens = {"d": np.array((0.1, 0.02, 0.003, 0.004, 0.0)), "k": np.array((500.0, 0, 320, 0, 510, 240, 0, 0, 1))}
    lens |= {"r": np.eye(3).ravel(), "p": np.zeros(12)} | changes
    made.stamped(
        "/camera/camera_info",
        T0,
        "sensor_msgs/msg/CameraInfo",
        frame="lens",
        height=480,
        width=640,
        distortion_model=kind,
        **{upper(name): value for name, value in lens.items()},
        binning_x=0,
        binning_y=0,
        roi=made.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


CAMERA = {"topic": "/camera/image_raw", "info": "/camera/camera_info"}


def test_the_camera_of_the_bag(maker, read_drive):
    """Lens from its message, place from frames: up a mast, 20 degrees down, with the frames of ROS between."""
    add_info(maker)
    add_image(maker, T0, np.zeros((480, 640)), "mono8")
    tilt = math.radians(20.0)
    down = (0.0, math.sin(tilt / 2), 0.0, math.cos(tilt / 2))
    optical = (-0.5, 0.5, -0.5, 0.5)  # as camera drivers publish it
    add_frames(
        maker,
        "/tf_static",
        T0,
        transform(maker, T0, "base_link", "mast", (0.1, 0.2, 1.0), heading=0.3),
        transform(maker, T0, "mast", "housing", (0.0, 0.0, 0.5), quaternion=down),
        transform(maker, T0, "housing", "lens", (0.0, 0.0, 0.0), quaternion=optical),
    )
    log = read_drive(maker, camera=CAMERA)
    camera = log.rig.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500.0, 510.0, 320.0, 240.0)
    assert camera.model().distortion == (0.1, 0.02, 0.003, 0.004)
    np.testing.assert_allclose((camera.x, camera.y, camera.z), (0.1, 0.2, 1.5), atol=1e-12)
    np.testing.assert_allclose((camera.roll, camera.pitch, camera.yaw), (0.0, tilt, 0.3), atol=1e-12)
    expected = mounting(0.0, tilt, 0.3)
    np.testing.assert_allclose(camera.model().rotation, expected, atol=1e-12)
    assert log.rig.sensors == ("odometry", "camera")


@pytest.mark.parametrize(
    ("kind", "numbers"),
    [
        ("plumb_bob", (0.1, 0.02, 0.003, 0.004, 0.01)),
        ("rational_polynomial", (0.01,) * 8),
        ("equidistant", (0.01,) * 4),
    ],
)
def test_lenses_of_several_kinds(maker, read_drive, kind, numbers):
    add_info(maker, kind, d=np.array(numbers))
    add_image(maker, T0, np.zeros((480, 640)), "mono8")
    camera = read_drive(maker, camera=CAMERA).rig.camera
    assert camera.distortion_model == kind
    assert camera.distortion == numbers
    assert camera.model().fisheye == (kind == "equidistant")


@pytest.mark.parametrize(("kind", "numbers"), [("fov", (0.9,)), ("plumb_bob", (0.1,) * 8)])
def test_lenses_without_a_model_are_refused(maker, refuse_drive, kind, numbers):
    add_info(maker, kind, d=np.array(numbers))
    add_image(maker, T0, np.zeros((480, 640)), "mono8")
    refuse_drive(maker, "/camera/camera_info:1:", kind, camera=CAMERA)


def test_images_pass_through_memory_one_at_a_time(maker, read_drive):
    """A bag of 24 MB is read in a third of that: a message, its chunk, and what the library keeps of the chunks."""
    data = np.zeros(400_000, dtype=np.uint8)
    data[:3] = (0xFF, 0xD8, 0xFF)
    for i in range(60):
        header = maker.header(T0 + i * MS)
        maker.write("/image", T0 + i * MS, "sensor_msgs/msg/CompressedImage", header=header, format="jpeg", data=data)
    maker.writer.close()
    maker.writer.close = lambda: None
    tracemalloc.start()
    images = read_drive(maker, camera={"topic": "/image"}).streams["camera"]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(images.file) == 60
    assert peak < 8e6
