"""Each kind of message that a bag may hold, and what is wrong with it now and then."""

import math
import tracemalloc

import cv2
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation

from factors import se2
from factors.reprojection import mounting

T0 = 1_700_000_000_000_000_000
MS = 1_000_000
COUNT = 5
MARKERS = """\
std_msgs/Header header
MarkerPose[] markers
================================================================================
MSG: aruco_opencv_msgs/MarkerPose
uint16 marker_id
geometry_msgs/Pose pose
"""
TAGS = """\
std_msgs/Header header
AprilTagDetection[] detections
================================================================================
MSG: apriltag_msgs/AprilTagDetection
string family
int32 id
Point[4] corners
================================================================================
MSG: apriltag_msgs/Point
float64 x
float64 y
"""


@pytest.fixture(params=["drive.bag", "drive"])
def maker(request, tmp_path, bag_maker, monkeypatch):
    """An open bag of each version with odometry."""
    monkeypatch.setenv("FGLOC_CACHE", str(tmp_path / "cache"))
    made = bag_maker(tmp_path / request.param)
    for i in range(COUNT):
        made.odometry("/odom", T0 + 100 * MS * i, (0.1 * i, 0.0, 0.0))
    return made


@pytest.fixture
def read(one):
    def call(made, **options):
        made.writer.close()
        return one(made.path, reader="rosbag", options={"odometry": {"topic": "/odom"}, **options})

    return call


@pytest.fixture
def refuse(refused):
    def call(made, *fragments, **options):
        made.writer.close()
        return refused(made.path, *fragments, reader="rosbag", options={"odometry": {"topic": "/odom"}, **options})

    return call


def transform(made, t_ns, parent, child, place, heading=0.0, quaternion=None):
    z, w = math.sin(heading / 2), math.cos(heading / 2)
    q = quaternion or (0.0, 0.0, z, w)
    return made.make(
        "geometry_msgs/msg/TransformStamped",
        header=made.header(t_ns, parent),
        child_frame_id=child,
        transform=made.make(
            "geometry_msgs/msg/Transform",
            translation=made.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", place, strict=True))),
            rotation=made.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", q, strict=True))),
        ),
    )


def add_frames(made, topic, t_ns, *transforms):
    made.write(topic, t_ns, "tf2_msgs/msg/TFMessage", transforms=list(transforms))


def add_image(made, t_ns, pixels, encoding, padding=0, kind=np.uint8):
    rows = np.ascontiguousarray(pixels.astype(kind)).reshape(len(pixels), -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    made.write(
        "/camera/image_raw",
        t_ns,
        "sensor_msgs/msg/Image",
        header=made.header(t_ns, "camera"),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=rows.shape[1],
        data=rows.ravel(),
    )


def test_velocities_with_and_without_a_header(maker, read, one):
    for i in range(COUNT):
        t = T0 + 100 * MS * i
        maker.write(
            "/twist", t, "geometry_msgs/msg/TwistStamped", header=maker.header(t - MS), twist=maker.twist(i, -i)
        )
        twist = maker.twist(2.0 * i, 0.5)
        maker.write("/cmd", t, "geometry_msgs/msg/Twist", linear=twist.linear, angular=twist.angular)
    log = read(maker, odometry={"topic": "/twist"})
    assert log.t0_ns == T0 - MS
    assert log.streams["odometry"].v.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert log.streams["odometry"].w.tolist() == [0.0, -1.0, -2.0, -3.0, -4.0]
    bare = one(maker.path, reader="rosbag", options={"odometry": {"topic": "/cmd"}})
    assert bare.t0_ns == T0
    assert bare.streams["odometry"].v.tolist() == [0.0, 2.0, 4.0, 6.0, 8.0]
    assert "as received: /cmd" in bare.metadata["clock"]


def add_wheels(made, left, right, names=("arm", "l", "r")):
    for i, (a, b) in enumerate(zip(left, right, strict=True)):
        t = T0 + 100 * MS * i
        made.write(
            "/joints",
            t,
            "sensor_msgs/msg/JointState",
            header=made.header(t),
            name=list(names),
            position=np.array((9.0, a, b)),
            velocity=np.array((9.0, 2.0 * i, 4.0 * i)),
            effort=np.zeros(0),
        )


WHEELS = {"left": "l", "right": "r", "radius": 0.1, "track": 0.4}


def test_wheels_as_a_differential_drive(maker, read, one):
    turned = np.arange(COUNT)
    add_wheels(maker, 2.0 * turned, 4.0 * turned)
    moved = read(maker, odometry={"topic": "/joints", "wheels": WHEELS}).streams["odometry"]
    # an arc of 0.3 m with a turn of 0.5 rad: radius 0.6 m
    expected = (0.6 * math.sin(0.5), 0.6 * (1.0 - math.cos(0.5)), 0.5)
    np.testing.assert_allclose(np.column_stack((moved.dx, moved.dy, moved.dtheta))[1:], [expected] * 4, atol=1e-12)
    options = {"odometry": {"topic": "/joints", "wheels": WHEELS, "use": "twist"}}
    speeds = one(maker.path, reader="rosbag", options=options).streams["odometry"]
    np.testing.assert_allclose(speeds.v, 0.3 * turned, atol=1e-12)
    np.testing.assert_allclose(speeds.w, 0.5 * turned, atol=1e-12)


def test_wheels_that_are_not_there(maker, refuse, refused):
    add_wheels(maker, [0.0, 1.0], [0.0, 1.0])
    wheels = WHEELS | {"right": "rr"}
    refuse(maker, "no message with both wheels, 'rr'", odometry={"topic": "/joints", "wheels": wheels})
    options = {"odometry": {"topic": "/joints"}}
    refused(maker.path, "odometry.wheels is missing", reader="rosbag", options=options)


def test_wheels_that_tell_their_speed_alone(maker, refuse):
    maker.write(
        "/joints",
        T0,
        "sensor_msgs/msg/JointState",
        header=maker.header(T0),
        name=["l", "r"],
        position=np.zeros(0),
        velocity=np.ones(2),
        effort=np.zeros(0),
    )
    options = {"topic": "/joints", "wheels": WHEELS}
    refuse(maker, "/joints:1: has 0 numbers of position for 2 joints", "odometry.use", odometry=options)


def add_imu(maker, rates):
    """A message of an IMU for each of ``rates`` (N, 3)."""
    for i, (x, y, z) in enumerate(rates):
        t = T0 + 100 * MS * i
        vectors = [maker.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z) for _ in range(2)]
        turn = maker.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        spread = {
            f"{name}_covariance": np.zeros(9) for name in ("orientation", "angular_velocity", "linear_acceleration")
        }
        told = {"orientation": turn, "angular_velocity": vectors[0], "linear_acceleration": vectors[1]}
        maker.write("/imu", t, "sensor_msgs/msg/Imu", header=maker.header(t), **told, **spread)


def test_the_gyro(maker, read):
    add_imu(maker, [(math.nan, 8.0, 0.1 * i) for i in range(COUNT)])
    log = read(maker, imu={"topic": "/imu"})
    np.testing.assert_allclose(log.streams["imu"].w, 0.1 * np.arange(COUNT))
    assert "imu" in log.rig.sensors


@pytest.mark.parametrize(
    ("options", "axis"),
    [
        ({"axes": "optical"}, (0.0, -1.0, 0.0)),  # y points down
        ({"axes": "y z x"}, (1.0, 0.0, 0.0)),
        ({"mounting": {"roll": math.pi}}, (0.0, 0.0, -1.0)),  # upside down
        ({"mounting": {"roll": 0.3}}, (0.0, math.sin(0.3), math.cos(0.3))),
        ({"mounting": {"pitch": 0.3}}, (-math.sin(0.3), 0.0, math.cos(0.3))),
        ({"mounting": {"yaw": 1.0}}, (0.0, 0.0, 1.0)),
        ({"frame": "imu_link"}, (0.0, 0.0, -1.0)),
    ],
)
def test_a_gyro_that_is_mounted_otherwise(maker, read, options, axis):
    add_frames(
        maker, "/tf_static", T0, transform(maker, T0, "base_link", "imu_link", (0, 0, 0), quaternion=(1.0, 0, 0, 0))
    )
    rates = np.random.default_rng(0).normal(size=(COUNT, 3))
    add_imu(maker, rates.tolist())
    np.testing.assert_allclose(read(maker, imu={"topic": "/imu", **options}).streams["imu"].w, rates @ axis, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        ({"axes": "x y"}, ("imu.axes is 'x y'", "the three axes that point ahead, left and up")),
        ({"axes": "y x z"}, ("right-handed",)),
        ({"frame": "imu_link"}, ("tf_static does not say where imu_link sits on base_link",)),
        ({"frame": "imu_link", "axes": "body"}, ("expected no axes or mounting",)),
        ({"mounting": {"roll": 90.0}}, ("imu.mounting.roll is 90.0",)),
    ],
)
def test_a_wrong_mounting(maker, refuse, options, fragments):
    add_imu(maker, [(0.0, 0.0, 0.1)] * COUNT)
    refuse(maker, *fragments, imu={"topic": "/imu", **options})


def add_poses(maker, poses):
    """Poses in space, of positions and quaternions (N, 7)."""
    for i, (x, y, z, *q) in enumerate(poses):
        pose = maker.make(
            "geometry_msgs/msg/Pose",
            position=maker.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=maker.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", q, strict=True))),
        )
        t = T0 + 100 * MS * i
        maker.write("/truth", t, "geometry_msgs/msg/PoseStamped", header=maker.header(t), pose=pose)


@pytest.mark.parametrize(
    ("rise", "tilt", "told"),
    [
        (0.2, 0.1, None),
        (0.5, 0.1, "poses rise by 0.50 m, which is left out"),
        (0.0, 0.5, "poses tilt by up to 29 degrees, which is left out"),
        (2.0, 0.5, "poses rise by 2.00 m and tilt by up to 29 degrees"),
        (92.0, 0.0, None),
    ],
)
def test_poses_that_leave_the_floor(maker, read, refuse, rise, tilt, told):
    q = (math.sin(tilt / 2.0), 0.0, 0.0, math.cos(tilt / 2.0))
    add_poses(maker, [(0.1 * i, 0.0, 5.0 + rise * i / (COUNT - 1), *q) for i in range(COUNT)])
    if rise > 3.0:
        refuse(maker, "/truth: poses rise by 92.0 m, expected a robot on a floor", reference={"topic": "/truth"})
        return
    log = read(maker, reference={"topic": "/truth"})
    warnings = [w for w in log.warnings if "/truth" in w and "poses" in w]
    assert len(warnings) == (told is not None)
    assert told is None or told in warnings[0]
    np.testing.assert_allclose(log.reference.poses, [(0.1 * i, 0.0, 0.0) for i in range(COUNT)], atol=1e-12)


def test_axes_and_mounting_of_poses(maker, read):
    """A camera that looks to the left, in the frame of a camera: its z axis is ahead, and it goes along that frame's z."""
    left = Rotation.from_euler("y", -90, degrees=True).as_quat()  # in optical axes y points down
    add_poses(maker, [(-0.1 * i, -4.0 * i, 0.5 * i, *left) for i in range(COUNT)])
    turned = {"axes": "optical", "mounting": {"yaw": math.pi / 2}}
    reference = read(maker, reference={"topic": "/truth", **turned}).reference
    np.testing.assert_allclose(reference.poses, [(0.5 * i, 0.1 * i, 0.0) for i in range(COUNT)], atol=1e-12)


def test_images_without_loss(maker, read, one):
    rng = np.random.default_rng(0)
    colour, grey = rng.integers(0, 256, (20, 30, 3)), rng.integers(0, 256, (20, 30))
    deep = rng.integers(0, 65536, (20, 30))
    add_image(maker, T0, colour, "rgb8", padding=6)
    add_image(maker, T0 + 100 * MS, colour, "bgr8")
    add_image(maker, T0 + 200 * MS, grey, "mono8", padding=2)
    add_image(maker, T0 + 300 * MS, deep, "mono16", kind=np.uint16)
    add_image(maker, T0 + 400 * MS, np.dstack((colour, grey)), "bgra8")
    images = read(maker, camera={"topic": "/camera/image_raw"}).streams["camera"]
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


def test_a_bayer_pattern_becomes_colour(maker, read):
    mosaic = np.zeros((20, 30))
    mosaic[::2, ::2] = 200.0  # red lies at even rows and columns
    add_image(maker, T0, mosaic, "bayer_rggb8")
    (file,) = read(maker, camera={"topic": "/camera/image_raw"}).streams["camera"].file
    blue, green, red = cv2.imread(str(file))[10, 10]
    assert (blue, green, red) == (0, 0, 200)


def test_images_of_a_kind_that_is_not_read(maker, refuse, tmp_path):
    add_image(maker, T0, np.zeros((4, 4)), "yuv422")
    refuse(maker, "image_raw:1: encoding is 'yuv422', expected one of mono8", camera={"topic": "/camera/image_raw"})
    assert [f for f in (tmp_path / "cache").rglob("*") if f.is_file()] == []


def test_an_image_with_too_few_bytes(maker, refuse, tmp_path):
    pixels = np.zeros((4, 4, 1))
    maker.write(
        "/camera/image_raw",
        T0,
        "sensor_msgs/msg/Image",
        header=maker.header(T0),
        height=5,
        width=4,
        encoding="mono8",
        is_bigendian=0,
        step=4,
        data=pixels.astype(np.uint8).ravel(),
    )
    refuse(maker, "image_raw:1: has 16 bytes, expected 5 rows of 4", camera={"topic": "/camera/image_raw"})
    assert not list((tmp_path / "cache" / "bags").iterdir())


def test_a_compressed_image_that_is_none(maker, refuse):
    data = np.frombuffer(b"nothing", dtype=np.uint8)
    kind = "sensor_msgs/msg/CompressedImage"
    maker.write("/image", T0, kind, header=maker.header(T0), format="compressedDepth", data=data)
    refuse(maker, "/image:1: format is 'compressedDepth', expected JPEG", camera={"topic": "/image"})


def add_info(made, **changes):
    upper = str.upper if made.ros1 else str
    lens = {"d": np.array((0.1, 0.02, 0.003, 0.004, 0.0)), "k": np.array((500.0, 0, 320, 0, 510, 240, 0, 0, 1))}
    lens |= {"r": np.eye(3).ravel(), "p": np.zeros(12)} | changes
    made.write(
        "/camera/camera_info",
        T0,
        "sensor_msgs/msg/CameraInfo",
        header=made.header(T0, "lens"),
        height=480,
        width=640,
        distortion_model="plumb_bob",
        **{upper(name): value for name, value in lens.items()},
        binning_x=0,
        binning_y=0,
        roi=made.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


CAMERA = {"topic": "/camera/image_raw", "info": "/camera/camera_info"}


def test_the_camera_of_the_bag(maker, read):
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
    log = read(maker, camera=CAMERA)
    camera = log.rig.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500.0, 510.0, 320.0, 240.0)
    assert camera.distortion == (0.1, 0.02, 0.003, 0.004)
    np.testing.assert_allclose((camera.x, camera.y, camera.z), (0.1, 0.2, 1.5), atol=1e-12)
    np.testing.assert_allclose((camera.roll, camera.pitch, camera.yaw), (0.0, tilt, 0.3), atol=1e-12)
    expected = mounting(0.0, tilt, 0.3)
    np.testing.assert_allclose(camera.model().rotation, expected, atol=1e-12)
    assert log.rig.sensors == ("odometry", "camera")


def test_a_lens_with_more_terms_and_a_camera_without_a_place(maker, read):
    add_info(maker, **{"d": np.array((0.1, 0.0, 0.0, 0.0, 0.7))})
    add_image(maker, T0, np.zeros((480, 640)), "mono8")
    told = read(maker, camera=CAMERA).metadata["robot"]
    assert "tf_static does not tell where lens sits on base_link" in told
    assert "only k1, k2, p1, p2 are taken, not [0.7]" in told


def test_a_lens_that_is_none(maker, refuse):
    add_info(maker, k=np.zeros(9))
    add_image(maker, T0, np.zeros((480, 640)), "mono8")
    refuse(maker, "/camera/camera_info: fx is 0.0", camera=CAMERA)


def test_antennas_by_their_frames(maker, read):
    maker.reads("/rfid", T0, [("E2AA", 1, -60.0, 0.0, T0), ("E2BB", 2, -60.0, 0.0, T0)])
    up = (0.0, -math.sin(0.25), 0.0, math.cos(0.25))
    left = transform(maker, T0, "base_link", "antenna_left", (0.1, 0.2, 0.7), heading=math.pi / 2)
    add_frames(maker, "/tf_static", T0, left, transform(maker, T0, "base_link", "2", (0.0, 0.0, 0.5), quaternion=up))
    fields = {"epc": "reads[].epc", "antenna": "reads[].antenna"}
    log = read(maker, rfid={"topic": "/rfid", "fields": fields, "frames": {"1": "antenna_left"}})
    first, second = log.rig.rfid.antennas["1"], log.rig.rfid.antennas["2"]
    np.testing.assert_allclose((first.x, first.y, first.z, first.yaw), (0.1, 0.2, 0.7, math.pi / 2))
    assert (round(second.pitch, 9), second.z) == (0.5, 0.5)


def test_a_reference_from_transforms(maker, read):
    """The correction of a map is slow, odometry is fast, and the robot's middle is not where odometry counts from."""
    odometry = np.array([(0.2 * i, 0.0, 0.1 * i) for i in range(COUNT)])
    for i, (x, y, heading) in enumerate(odometry):
        t = T0 + 100 * MS * i
        add_frames(maker, "/tf", t, transform(maker, t, "odom", "footprint", (x, y, 0.0), heading))
        if i in {0, COUNT - 1}:
            add_frames(maker, "/tf", t, transform(maker, t, "map", "odom", (5.0, i, 0.0), heading=math.pi / 2))
    add_frames(maker, "/tf_static", T0, transform(maker, T0, "footprint", "base_link", (0.3, 0.0, 0.0)))
    reference = read(maker, reference={"topic": "/tf", "parent": "map", "child": "base_link"}).reference
    np.testing.assert_allclose(reference.t, 0.1 * np.arange(COUNT), atol=1e-9)
    corrections = np.column_stack((np.full(COUNT, 5.0), np.arange(COUNT), np.full(COUNT, math.pi / 2)))
    expected = se2.compose(se2.compose(corrections, odometry), np.array((0.3, 0.0, 0.0)))
    np.testing.assert_allclose(reference.poses, expected, atol=1e-9)


def test_transforms_that_lead_nowhere(maker, refuse, refused):
    for i in range(2):
        t = T0 + i * MS
        add_frames(maker, "/tf", t, transform(maker, t, "odom", "base_link", (0.0, 0.0, 0.0)))
    tf = {"topic": "/tf", "parent": "map", "child": "base_link"}
    refuse(maker, "no transforms lead from base_link to map: there is no frame 'map'", reference=tf)
    options = {"odometry": {"topic": "/odom"}, "reference": {"topic": "/tf"}}
    refused(maker.path, "reference.parent and reference.child are missing", reader="rosbag", options=options)


def test_a_rotation_that_is_none(maker, refuse):
    add_frames(maker, "/tf_static", T0, transform(maker, T0, "a", "b", (0.0, 0.0, 0.0), quaternion=(0.0,) * 4))
    refuse(maker, "/tf_static:1: length of the quaternion is 0.0, expected 1")


def add_markers(made, place):
    made.store.register(get_types_from_msg(MARKERS, "aruco_opencv_msgs/msg/ArucoDetection"))
    pose = made.pose(place[0], place[1], 0.0, z=place[2])
    marker = made.make("aruco_opencv_msgs/msg/MarkerPose", marker_id=7, pose=pose)
    header = made.header(T0 + 50 * MS, "lens")
    made.write("/markers", T0 + 50 * MS, "aruco_opencv_msgs/msg/ArucoDetection", header=header, markers=[marker])


def test_markers_that_a_detector_found(maker, read):
    add_markers(maker, (-1.0, 0.2, 2.0))  # in optical axes: left, below, ahead
    seen = read(maker, bearing_range={"topic": "/markers"}).streams["bearing_range"]
    assert seen.landmark == ["7"]
    np.testing.assert_allclose((seen.t[0], seen.range[0], seen.bearing[0]), (0.05, math.sqrt(5.0), math.atan2(1, 2)))


def test_markers_in_the_robots_frame(maker, read):
    add_markers(maker, (0.0, 0.0, 2.0))
    optical = transform(maker, T0, "base_link", "lens", (0.5, 0.0, 1.0), quaternion=(-0.5, 0.5, -0.5, 0.5))
    add_frames(maker, "/tf_static", T0, optical)
    seen = read(maker, bearing_range={"topic": "/markers", "frame": "lens"}).streams["bearing_range"]
    np.testing.assert_allclose((seen.range[0], seen.bearing[0]), (2.5, 0.0), atol=1e-12)


def test_a_frame_of_markers_that_is_not_told(maker, refuse):
    add_markers(maker, (0.0, 0.0, 2.0))
    options = {"topic": "/markers", "frame": "lens"}
    refuse(maker, "tf_static does not say where lens sits on base_link; frames: none", bearing_range=options)


def test_landmarks_of_a_type_that_is_not_known(maker, refuse, refused):
    maker.reads("/rfid", T0, [("E2AA", 1, -60.0, 0.0, T0)])
    refuse(
        maker,
        "/rfid is of type shop_msgs/msg/Reads: give its fields; known without: apriltag_ros",
        bearing_range={"topic": "/rfid"},
    )
    options = {
        "odometry": {"topic": "/odom"},
        "bearing_range": {"topic": "/rfid", "fields": {"landmark": "reads[].epc"}},
    }
    refused(maker.path, "fields are landmark, expected landmark with x, y and z", reader="rosbag", options=options)


def test_corners_of_tags(maker, read):
    maker.store.register(get_types_from_msg(TAGS, "apriltag_msgs/msg/AprilTagDetectionArray"))
    corners = [maker.make("apriltag_msgs/msg/Point", x=10.0 + i, y=20.0 + i) for i in range(4)]
    tag = maker.make("apriltag_msgs/msg/AprilTagDetection", family="tag36h11", id=5, corners=corners)
    kind = "apriltag_msgs/msg/AprilTagDetectionArray"
    maker.write("/tags", T0, kind, header=maker.header(T0), detections=[tag])
    seen = read(maker, sightings={"topic": "/tags"}).streams["sightings"]
    assert seen.point == [f"tag36h11-5/{i}" for i in (3, 2, 1, 0)]  # from the lower left
    assert seen.u.tolist() == [10.0, 11.0, 12.0, 13.0]
    assert seen.v.tolist() == [20.0, 21.0, 22.0, 23.0]


def test_images_pass_through_memory_one_at_a_time(maker, read):
    """A bag of 24 MB is read in a third of that: a message, its chunk, and what the library keeps of the chunks."""
    data = np.zeros(400_000, dtype=np.uint8)
    data[:3] = (0xFF, 0xD8, 0xFF)
    for i in range(60):
        header = maker.header(T0 + i * MS)
        maker.write("/image", T0 + i * MS, "sensor_msgs/msg/CompressedImage", header=header, format="jpeg", data=data)
    maker.writer.close()
    maker.writer.close = lambda: None
    tracemalloc.start()
    images = read(maker, camera={"topic": "/image"}).streams["camera"]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(images.file) == 60
    assert peak < 8e6


def test_detections_of_tags_without_corners(maker, refuse):
    lacking = TAGS.replace("Point[4] corners\n", "")
    maker.store.register(get_types_from_msg(lacking, "apriltag_msgs/msg/AprilTagDetectionArray"))
    tag = maker.make("apriltag_msgs/msg/AprilTagDetection", family="tag36h11", id=5)
    kind = "apriltag_msgs/msg/AprilTagDetectionArray"
    maker.write("/tags", T0, kind, header=maker.header(T0), detections=[tag])
    refuse(maker, "lacks detections[].corners[].x, detections[].corners[].y", sightings={"topic": "/tags"})
