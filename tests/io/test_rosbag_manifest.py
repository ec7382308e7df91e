"""The manifest that is proposed for a bag: which topic is taken for which sensor, and what a person is told to look at."""

import tomllib

import numpy as np
import pytest
import tomli_w
from rosbag_drive import add_imu
from rosbags.typesys import get_types_from_msg

import factorgraph_loc as fgloc
from factorgraph_loc.io.bags.file import open_bag
from factorgraph_loc.io.bags.manifest import manifest_of_bag, propose, read_fields

T0 = 1_700_000_000_000_000_000


@pytest.fixture
def proposal(tmp_path, bag_maker):
    """``proposal(fill)``: what is proposed for a bag that ``fill`` writes, and the manifest as it is parsed."""

    def call(fill):
        with bag_maker(tmp_path / "drive.bag") as made:
            fill(made)
        text = manifest_of_bag(tmp_path / "drive.bag", tmp_path).text
        with open_bag(tmp_path / "drive.bag") as bag:
            return propose(bag), tomllib.loads(text), text

    return call


def pose_of(made, topic, kind="geometry_msgs/msg/PoseStamped"):
    made.stamped(topic, T0, kind, pose=made.pose(0.0, 0.0, 0.0))


def test_odometry_and_truth_are_told_apart_by_their_names(proposal):
    def fill(made):
        made.odometry("/ground_truth/odom", T0, (0.0, 0.0, 0.0))
        made.odometry("/odom", T0, (0.0, 0.0, 0.0))
        made.odometry("/wheel_odom", T0, (0.0, 0.0, 0.0))
        pose_of(made, "/move_base/goal")

    found, manifest, text = proposal(fill)
    assert manifest["options"] == {"odometry": {"topic": "/odom"}, "reference": {"topic": "/ground_truth/odom"}}
    assert "# odometry could also be /wheel_odom" in text
    assert "# not used: /move_base/goal (geometry_msgs/msg/PoseStamped, 1 messages)" in text
    assert found.uses == {"/odom": "odometry", "/ground_truth/odom": "reference"}


def test_odometry_without_poses_is_read_by_its_velocities(proposal, tmp_path):
    def fill(made):
        for i in range(3):
            made.odometry("/odom", T0 + i * 10**8, (0.0, 0.0, 0.0), v=0.5, turned=False)
        pose_of(made, "/robot_pose")
        made.write("/depth", T0, "sensor_msgs/msg/Range", **range_of(made))

    found, manifest, text = proposal(fill)
    assert found.options["odometry"] == {"topic": "/odom", "use": "twist"}
    assert "# the quaternions in /odom are zero: its velocities are used, not its poses\n" in text
    del manifest["options"]["reference"]
    (tmp_path / "drive.toml").write_text(tomli_w.dumps(manifest))
    log = fgloc.read_log(tmp_path / "drive.toml")
    np.testing.assert_array_equal(log.streams["odometry"].v, (0.5, 0.5, 0.5))
    # what the manifest leaves out is told
    assert log.metadata["not read"] == "/depth (sensor_msgs/msg/Range), /robot_pose (geometry_msgs/msg/PoseStamped)"


def range_of(made):
    numbers = dict.fromkeys(("field_of_view", "min_range", "max_range", "range"), 1.0)
    return {"header": made.header(T0), "radiation_type": 0, **numbers}


def test_reads_by_the_names_of_fields(proposal):
    def fill(made):
        made.reads("/rfid", T0, [("E2AA", 1, -60.0, 0.0, T0)])

    found, _, text = proposal(fill)
    rfid = found.options["rfid"]
    assert rfid["fields"] == {
        "epc": "reads[].epc",
        "antenna": "reads[].antenna",
        "rssi": "reads[].rssi",
        "phase": "reads[].phase_degrees",
        "stamp": "reads[].first_seen_us",
    }
    assert rfid["units"] == {"phase": "deg", "stamp": "us"}
    assert "rounds" not in rfid
    assert "no topic was recognised as odometry" in text


@pytest.mark.parametrize(
    ("paths", "expected"),
    [
        (
            ["header.stamp", "tag_id", "antenna_port", "peak_rssi"],
            {"epc": "tag_id", "antenna": "antenna_port", "rssi": "peak_rssi"},
        ),
        (["id", "x"], {}),
        (["tags[].epc", "tags[].stamp", "port"], {"epc": "tags[].epc", "antenna": "port", "stamp": "tags[].stamp"}),
        (
            ["a.tagId", "a.rf_phase_angle", "a.channel_frequency"],
            {"epc": "a.tagId", "phase": "a.rf_phase_angle", "frequency": "a.channel_frequency"},
        ),
    ],
)
def test_usual_names_of_fields(paths, expected):
    assert read_fields(paths) == expected


def test_ranges_of_radios_by_the_names_of_fields(proposal, tmp_path):
    def fill(made):
        kind = "uwb/msg/Range"
        made.store.register(
            get_types_from_msg("std_msgs/Header header\nuint16 anchor_id\nuint16 tag_id\nfloat32 distance\n", kind)
        )
        for i in range(3):
            made.odometry("/odom", T0 + i * 10**8, (0.1 * i, 0.0, 0.0))
            made.write("/uwb", T0, kind, header=made.header(T0 + i * 10**8), anchor_id=7, tag_id=1, distance=2.0 + i)

    found, manifest, text = proposal(fill)
    fields = {"landmark": "anchor_id", "range": "distance"}
    assert found.options["bearing_range"] == {"topic": "/uwb", "fields": fields}
    assert "# /uwb is read as ranges [m] to landmarks of the map; anchor_id has the name of the landmark\n" in text
    (tmp_path / "drive.toml").write_text(tomli_w.dumps(manifest))
    ranges = fgloc.read_log(tmp_path / "drive.toml").streams["bearing_range"]
    assert list(ranges.landmark) == ["7"] * 3
    np.testing.assert_array_equal(ranges.range, (2.0, 3.0, 4.0))


def test_topics_of_several_sensors_of_landmarks(proposal, tmp_path):
    def fill(made):
        kind = "fiducial_msgs/msg/FiducialTransformArray"
        single = "int32 fiducial_id\ngeometry_msgs/Transform transform\n"
        made.store.register(get_types_from_msg(single, "fiducial_msgs/msg/FiducialTransform"))
        made.store.register(
            get_types_from_msg("std_msgs/Header header\nfiducial_msgs/FiducialTransform[] transforms\n", kind)
        )
        radio = "uwb/msg/Range"
        made.store.register(get_types_from_msg("std_msgs/Header header\nuint16 anchor_id\nfloat32 distance\n", radio))
        types = made.store.types
        for i in range(3):
            made.odometry("/odom", T0 + i * 10**8, (0.1 * i, 0.0, 0.0))
            for k, side in enumerate(("front", "rear")):
                at = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=2.0 + k)
                turned = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
                transform = types["geometry_msgs/msg/Transform"](translation=at, rotation=turned)
                found = types["fiducial_msgs/msg/FiducialTransform"](fiducial_id=5 + k, transform=transform)
                made.stamped(f"/{side}/fiducials", T0 + i * 10**8, kind, transforms=[found])
            made.stamped("/uwb", T0 + i * 10**8, radio, anchor_id=7, distance=4.0)

    found, manifest, text = proposal(fill)
    assert set(manifest["options"]["bearing_range"]) == {"front_fiducials", "rear_fiducials", "uwb"}
    assert '[options.bearing_range.front_fiducials]\ntopic = "/front/fiducials"' in text
    assert found.uses["/rear/fiducials"] == "bearing_range.rear_fiducials"
    assert "are separate sensors" in text
    (tmp_path / "drive.toml").write_text(tomli_w.dumps(manifest))
    log = fgloc.read_log(tmp_path / "drive.toml")
    assert set(log.streams["bearing_range.uwb"].range) == {4.0}
    assert set(log.streams["bearing_range.rear_fiducials"].range) == {3.0}
    assert log.rig.sensors == ("odometry", *(name for name in log.streams if name != "odometry"))


def test_images_and_what_tells_of_their_camera(proposal):
    def fill(made):
        made.odometry("/odom", T0, (0.0, 0.0, 0.0))
        for topic in ("/front/image_raw/compressed", "/front/depth/compressed"):
            kind = "sensor_msgs/msg/CompressedImage"
            made.stamped(topic, T0, kind, format="jpeg", data=np.zeros(3, dtype=np.uint8))

    found, _, text = proposal(fill)
    assert found.options["camera"] == {"topic": "/front/image_raw/compressed"}
    assert "the images have no CameraInfo topic" in text


def test_what_is_proposed_of_odometry_and_a_gyro_is_used_by_a_run(proposal, tmp_path):
    """Odometry as poses that go straight on, and a gyro that says a circle: the heading of the run is the gyro's."""

    def fill(made):
        for i in range(31):
            t = T0 + 100_000_000 * i
            made.odometry("/odom", t, (0.05 * i, 0.0, 0.0))
            add_imu(made, [(0.0, 0.0, 0.3)], "/imu/data", t + 20_000_000)

    found, _, text = proposal(fill)
    assert found.uses == {"/odom": "odometry", "/imu/data": "imu"}
    (tmp_path / "run.toml").write_text(text)
    log = fgloc.read_log(tmp_path / "run.toml")
    result = fgloc.run(log, "ekf", prior="0,0,0").result
    assert result.config["sensors"] == ["odometry", "imu"]
    assert result.diagnostics.ignored == {}
    assert result.final.poses[-1, 2] == pytest.approx(0.9, abs=0.02)
