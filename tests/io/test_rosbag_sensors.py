"""Each kind of message that a bag may hold, and what is wrong with it now and then."""

import math

import numpy as np
import pytest
from rosbag_drive import COUNT, MS, T0, add_frames, add_imu, proposed, transform
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation

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


def test_velocities_with_and_without_a_header(maker, read_drive, one):
    for i in range(COUNT):
        t = T0 + 100 * MS * i
        maker.write(
            "/twist", t, "geometry_msgs/msg/TwistStamped", header=maker.header(t - MS), twist=maker.twist(i, -i)
        )
        twist = maker.twist(2.0 * i, 0.5)
        maker.write("/cmd", t, "geometry_msgs/msg/Twist", linear=twist.linear, angular=twist.angular)
    log = read_drive(maker, odometry={"topic": "/twist"})
    assert log.t0_ns == T0 - MS
    assert log.streams["odometry"].v.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert log.streams["odometry"].w.tolist() == [0.0, -1.0, -2.0, -3.0, -4.0]
    bare = one(maker.path, reader="rosbag", options={"odometry": {"topic": "/cmd"}})
    assert bare.t0_ns == T0
    assert bare.streams["odometry"].v.tolist() == [0.0, 2.0, 4.0, 6.0, 8.0]
    assert "have the time of receipt: /cmd" in bare.metadata["clock"]


def test_the_gyro(maker, read_drive):
    add_imu(maker, [(math.nan, 8.0, 0.1 * i) for i in range(COUNT)])
    log = read_drive(maker, imu={"topic": "/imu"})
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
def test_a_gyro_that_is_mounted_otherwise(maker, read_drive, options, axis):
    add_frames(
        maker, "/tf_static", T0, transform(maker, T0, "base_link", "imu_link", (0, 0, 0), quaternion=(1.0, 0, 0, 0))
    )
    rates = np.random.default_rng(0).normal(size=(COUNT, 3))
    add_imu(maker, rates.tolist())
    np.testing.assert_allclose(
        read_drive(maker, imu={"topic": "/imu", **options}).streams["imu"].w, rates @ axis, atol=1e-12
    )


def add_poses(maker, poses):
    """Poses in space, of positions and quaternions (N, 7)."""
    for i, (x, y, z, *q) in enumerate(poses):
        maker.stamped(
            "/truth", T0 + 100 * MS * i, "geometry_msgs/msg/PoseStamped", pose=maker.pose_in_space((x, y, z), q)
        )


@pytest.mark.parametrize(
    ("rise", "tilt", "told"),
    [
        (0.2, 0.1, None),
        (0.5, 0.1, "poses vary in height by 0.50 m, which is ignored"),
        (0.0, 0.5, "poses tilt by up to 29 degrees, which is ignored"),
        (2.0, 0.5, "poses vary in height by 2.00 m and tilt by up to 29 degrees"),
        (92.0, 0.0, None),
    ],
)
def test_poses_that_leave_the_floor(maker, read_drive, refuse_drive, rise, tilt, told):
    q = (math.sin(tilt / 2.0), 0.0, 0.0, math.cos(tilt / 2.0))
    add_poses(maker, [(0.1 * i, 0.0, 5.0 + rise * i / (COUNT - 1), *q) for i in range(COUNT)])
    if rise > 3.0:
        refuse_drive(
            maker,
            "/truth: the height of poses varies by 92.0 m, expected a robot on a floor",
            reference={"topic": "/truth"},
        )
        return
    log = read_drive(maker, reference={"topic": "/truth"})
    warnings = [str(w) for w in log.warnings if w.kind == "not_planar"]
    assert len(warnings) == (told is not None)
    assert told is None or told in warnings[0]
    np.testing.assert_allclose(log.reference.poses, [(0.1 * i, 0.0, 0.0) for i in range(COUNT)], atol=1e-12)


def test_axes_and_mounting_of_poses(maker, read_drive):
    """A camera that looks to the left, in the frame of a camera: its z axis is ahead, and it goes along that frame's z."""
    left = Rotation.from_euler("y", -90, degrees=True).as_quat()  # in optical axes y points down
    add_poses(maker, [(-0.1 * i, -4.0 * i, 0.5 * i, *left) for i in range(COUNT)])
    turned = {"axes": "optical", "mounting": {"yaw": math.pi / 2}}
    reference = read_drive(maker, reference={"topic": "/truth", **turned}).reference
    np.testing.assert_allclose(reference.poses, [(0.5 * i, 0.1 * i, 0.0) for i in range(COUNT)], atol=1e-12)


def test_antennas_by_their_frames(maker, read_drive):
    maker.reads("/rfid", T0, [("E2AA", 1, -60.0, 0.0, T0), ("E2BB", 2, -60.0, 0.0, T0)])
    up = (0.0, -math.sin(0.25), 0.0, math.cos(0.25))
    left = transform(maker, T0, "base_link", "antenna_left", (0.1, 0.2, 0.7), heading=math.pi / 2)
    add_frames(maker, "/tf_static", T0, left, transform(maker, T0, "base_link", "2", (0.0, 0.0, 0.5), quaternion=up))
    fields = {"epc": "reads[].epc", "antenna": "reads[].antenna"}
    log = read_drive(maker, rfid={"topic": "/rfid", "fields": fields, "frames": {"1": "antenna_left"}})
    first, second = log.rig.rfid.antennas["1"], log.rig.rfid.antennas["2"]
    np.testing.assert_allclose((first.x, first.y, first.z, first.yaw), (0.1, 0.2, 0.7, math.pi / 2))
    assert (round(second.pitch, 9), second.z) == (0.5, 0.5)


def add_markers(made, place):
    made.store.register(get_types_from_msg(MARKERS, "aruco_opencv_msgs/msg/ArucoDetection"))
    pose = made.pose(place[0], place[1], 0.0, z=place[2])
    marker = made.make("aruco_opencv_msgs/msg/MarkerPose", marker_id=7, pose=pose)
    header = made.header(T0 + 50 * MS, "lens")
    made.write("/markers", T0 + 50 * MS, "aruco_opencv_msgs/msg/ArucoDetection", header=header, markers=[marker])


def test_markers_that_a_detector_found(maker, read_drive):
    add_markers(maker, (-1.0, 0.2, 2.0))  # in optical axes: left, below, ahead
    seen = read_drive(maker, bearing_range={"topic": "/markers"}).streams["bearing_range"]
    assert seen.landmark == ["7"]
    np.testing.assert_allclose((seen.t[0], seen.range[0], seen.bearing[0]), (0.05, math.sqrt(5.0), math.atan2(1, 2)))


def test_markers_in_the_robots_frame(maker, read_drive):
    add_markers(maker, (0.0, 0.0, 2.0))
    optical = transform(maker, T0, "base_link", "lens", (0.5, 0.0, 1.0), quaternion=(-0.5, 0.5, -0.5, 0.5))
    add_frames(maker, "/tf_static", T0, optical)
    seen = read_drive(maker, bearing_range={"topic": "/markers", "frame": "lens"}).streams["bearing_range"]
    np.testing.assert_allclose((seen.range[0], seen.bearing[0]), (2.5, 0.0), atol=1e-12)


def test_corners_of_tags(maker, read_drive):
    maker.store.register(get_types_from_msg(TAGS, "apriltag_msgs/msg/AprilTagDetectionArray"))
    corners = [maker.make("apriltag_msgs/msg/Point", x=10.0 + i, y=20.0 + i) for i in range(4)]
    tag = maker.make("apriltag_msgs/msg/AprilTagDetection", family="tag36h11", id=5, corners=corners)
    kind = "apriltag_msgs/msg/AprilTagDetectionArray"
    maker.stamped("/tags", T0, kind, detections=[tag])
    seen = read_drive(maker, sightings={"topic": "/tags"}).streams["sightings"]
    assert seen.point == [f"tag36h11-5/{i}" for i in (3, 2, 1, 0)]  # from the lower left
    assert seen.u.tolist() == [10.0, 11.0, 12.0, 13.0]
    assert seen.v.tolist() == [20.0, 21.0, 22.0, 23.0]


def test_a_start(maker, read_drive):
    spread = np.zeros((6, 6))
    spread[[0, 1, 5], [0, 1, 5]] = 0.01, 0.04, 0.09
    pose = maker.make("geometry_msgs/msg/PoseWithCovariance", pose=maker.pose(1.0, 2.0, 3.0), covariance=spread.ravel())
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    maker.stamped("/initialpose", T0 + 250 * MS, kind, frame="map", pose=pose)
    start = read_drive(maker, start={"topic": "/initialpose"}).start
    assert start.t == pytest.approx(0.25)
    np.testing.assert_allclose(start.pose, (1.0, 2.0, 3.0), atol=1e-12)
    np.testing.assert_allclose(start.sigmas, (0.1, 0.2, 0.3), atol=1e-12)
    assert proposed(maker.path).options["start"] == {"topic": "/initialpose"}


def test_landmarks_and_pixels_by_a_mapping(maker, read_drive):
    maker.reads("/seen", T0, [("AB", 1, 2.5, 0.5, T0), ("CD", 1, 3.5, -0.5, T0)])
    numbers = ("reads[].rssi", "reads[].phase_degrees")
    polar, pixels = (
        {"topic": "/seen", "fields": {"landmark": "reads[].epc", **dict(zip(names, numbers, strict=True))}}
        for names in (("range", "bearing"), ("u", "v"))
    )
    log = read_drive(maker, bearing_range=polar, sightings=pixels)
    seen, shown = log.streams["bearing_range"], log.streams["sightings"]
    assert (seen.landmark, seen.range.tolist(), seen.bearing.tolist()) == (["AB", "CD"], [2.5, 3.5], [0.5, -0.5])
    assert (shown.point, shown.u.tolist(), shown.v.tolist()) == (["AB", "CD"], [2.5, 3.5], [0.5, -0.5])


def test_positions_of_a_bag_with_their_covariances(maker, read_drive):
    covariance = np.zeros(36)
    covariance[[0, 1, 7]] = 0.04, 0.01, 0.09
    for i in range(3):
        pose = maker.make(
            "geometry_msgs/msg/PoseWithCovariance", pose=maker.pose(1.0 + i, 2.0, 0.0), covariance=covariance
        )
        maker.stamped("/uwb", T0 + 100 * MS * i, "geometry_msgs/msg/PoseWithCovarianceStamped", pose=pose)
    stream = read_drive(maker, position={"topic": "/uwb"}).streams["position"]
    np.testing.assert_allclose(stream.x, (1.0, 2.0, 3.0))
    np.testing.assert_allclose((stream.var_x[0], stream.cov_xy[0], stream.var_y[0]), (0.04, 0.01, 0.09))
    assert proposed(maker.path).options["position"] == {"topic": "/uwb"}


def add_fixes(maker, topic, latitudes):
    for i, latitude in enumerate(latitudes):
        status = maker.make("sensor_msgs/msg/NavSatStatus", status=0, service=1)
        maker.stamped(
            topic,
            T0 + 100 * MS * i,
            "sensor_msgs/msg/NavSatFix",
            status=status,
            latitude=latitude,
            longitude=10.0,
            altitude=5.0,
            position_covariance=np.zeros(9),
            position_covariance_type=0,
        )


def test_fixes_of_a_bag_are_metres_from_the_first(maker, read_drive):
    add_fixes(maker, "/fix", [60.0 + i / 3600.0 for i in range(3)])
    log = read_drive(maker, position={"topic": "/fix"})
    np.testing.assert_allclose(log.streams["position"].y, (0.0, 30.9, 61.9), atol=0.1)
    assert "origin" in [warning.kind for warning in log.warnings]
    assert proposed(maker.path).options["position"] == {"topic": "/fix"}


def test_two_receivers_have_one_origin(maker, read_drive):
    for name, shift in (("front", 0.0), ("rear", -1.0)):
        add_fixes(maker, f"/{name}", [60.0 + (shift + i) / 3600.0 for i in range(3)])
    log = read_drive(maker, position={name: {"topic": f"/{name}"} for name in ("front", "rear")})
    front, rear = (log.streams[f"position.{name}"].y for name in ("front", "rear"))
    np.testing.assert_allclose(front, (0.0, 30.9, 61.9), atol=0.1)
    np.testing.assert_allclose(rear, front - 30.95, atol=0.02)
    assert [warning.kind for warning in log.warnings].count("origin") == 1


def test_fixes_that_a_receiver_has_not(maker, read_drive):
    add_fixes(maker, "/fix", [60.0, 60.0 + 1.0 / 3600.0])
    maker.stamped(
        "/fix",
        T0 + 300 * MS,
        "sensor_msgs/msg/NavSatFix",
        status=maker.make("sensor_msgs/msg/NavSatStatus", status=-1, service=1),
        latitude=0.0,
        longitude=0.0,
        altitude=0.0,
        position_covariance=np.zeros(9),
        position_covariance_type=0,
    )
    log = read_drive(maker, position={"topic": "/fix"})
    assert len(log.streams["position"].t) == 2
    (warning,) = [str(warning) for warning in log.warnings if warning.kind == "no_fix"]
    assert "/fix:3: latitude and longitude are 0, in the first of 1 rows without a fix" in warning
