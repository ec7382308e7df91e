"""The written file is read again with rosbags."""

from dataclasses import replace

import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from factorgraph_loc import InputError, Trajectory
from factorgraph_loc.exports.ros import write_mcap
from factorgraph_loc.exports.runs import find_runs, read_runs
from factorgraph_loc.model.belief import LearntPoint

from .conftest import STEPS, T0_NS

STORE = get_typestore(Stores.ROS2_HUMBLE)


class Messages:
    """The messages of a file by topic, as (time of the log [s], message), and the type of each topic."""

    def __init__(self, path):
        self.of, self.ns = {}, []
        with Reader(path) as reader:
            self.types = {connection.topic: connection.msgtype for connection in reader.connections}
            for connection, ns, raw in reader.messages():
                message = STORE.deserialize_cdr(raw, connection.msgtype)
                self.ns.append(ns)
                self.of.setdefault(connection.topic, []).append(((ns - T0_NS) / 1e9, message))

    def __getitem__(self, topic):
        return self.of[topic]


def pose_of(pose):
    assert (pose.position.z, pose.orientation.x, pose.orientation.y) == (0.0, 0.0, 0.0)
    return pose.position.x, pose.position.y, 2.0 * np.arctan2(pose.orientation.z, pose.orientation.w)


def stamp_of(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


@pytest.fixture(scope="module")
def runs(log, results):
    return read_runs(find_runs(results), log)


@pytest.fixture(scope="module")
def messages(log, runs, tmp_path_factory):
    path = tmp_path_factory.mktemp("ros") / "arc.mcap"
    write_mcap(log, runs, path)
    return Messages(path)


def test_topics_and_their_types(messages):
    expected = {"/tf": "tf2_msgs/msg/TFMessage", "/markers": "visualization_msgs/msg/MarkerArray"}
    expected["/camera/image/compressed"] = "sensor_msgs/msg/CompressedImage"
    for name in ("ekf", "dead_reckoning", "reference"):
        expected |= {f"/{name}/odometry": "nav_msgs/msg/Odometry", f"/{name}/path": "nav_msgs/msg/Path"}
    assert messages.types == expected
    assert messages.ns == sorted(messages.ns)


def test_odometry_has_the_causal_estimates_with_covariances(messages, runs):
    for run in runs:
        found = messages[f"/{run.name}/odometry"]
        assert np.allclose([t for t, _ in found], run.causal.t, atol=1e-6)
        assert all(stamp_of(m.header) == T0_NS + round(t * 1e9) for t, m in found)
        assert {(m.header.frame_id, m.child_frame_id) for _, m in found} == {("map", f"{run.name}/base_link")}
        assert np.allclose([pose_of(m.pose.pose) for _, m in found], run.causal.poses)
        covariances = np.array([m.pose.covariance.reshape(6, 6) for _, m in found])
        planar = np.ix_(range(len(found)), (0, 1, 5), (0, 1, 5))
        assert np.allclose(covariances[planar], run.causal.covariances, rtol=1e-12)
        covariances[planar] = 0.0
        assert not covariances.any()
        assert all(m.twist.covariance[0] == -1.0 for _, m in found)


def test_paths_are_final_trajectories(messages, runs, log):
    for name, final in (*((run.name, run.final) for run in runs), ("reference", log.reference)):
        ((_, path),) = messages[f"/{name}/path"]
        assert path.header.frame_id == "map"
        assert np.allclose([pose_of(p.pose) for p in path.poses], final.poses, atol=1e-9)
        assert np.allclose([(stamp_of(p.header) - T0_NS) / 1e9 for p in path.poses], final.t, atol=1e-6)


def test_frames_of_the_robot(messages, runs, log):
    found = {}
    for t, message in messages["/tf"]:
        (transform,) = message.transforms
        assert transform.header.frame_id == "map"
        assert stamp_of(transform.header) == T0_NS + round(t * 1e9)
        place, turn = transform.transform.translation, transform.transform.rotation
        pose = (place.x, place.y, 2.0 * np.arctan2(turn.z, turn.w))
        found.setdefault(transform.child_frame_id, []).append(pose)
    expected = {f"{run.name}/base_link": run.causal.poses for run in runs}
    expected["reference/base_link"] = log.reference.poses
    assert set(found) == set(expected)
    for frame, poses in expected.items():
        assert np.allclose(found[frame], poses, atol=1e-9)


def test_markers_of_the_map(messages):
    ((_, array),) = messages["/markers"]
    assert [marker.id for marker in array.markers] == list(range(len(array.markers)))
    assert {marker.header.frame_id for marker in array.markers} == {"map"}
    shapes = {marker.ns: marker for marker in array.markers if not marker.text}
    assert {name: marker.type for name, marker in shapes.items()} == {"walls": 5, "tags": 7, "landmarks": 7}
    assert [(p.x, p.y, p.z) for p in shapes["walls"].points] == [(-1.0, -3.0, 0.0), (4.0, -3.0, 0.0)]
    assert [(p.x, p.y, p.z) for p in shapes["tags"].points] == [(0.5, 1.0, 1.2), (1.5, 1.0, 0.4)]
    labels = {marker.text: marker.pose.position for marker in array.markers if marker.text}
    assert set(labels) == {"A", "B", "door", "post"}
    assert (labels["A"].x, labels["A"].y) == (0.5, 1.0)
    assert labels["A"].z > 1.2


def test_images(messages, log):
    images = messages["/camera/image/compressed"]
    assert np.allclose([t for t, _ in images], log.streams["camera"].t, atol=1e-6)
    assert all(m.format == "jpeg" and m.data.tobytes()[:2] == b"\xff\xd8" for _, m in images)


def test_a_single_run_is_base_link_and_has_its_landmarks(log, runs, tmp_path):
    run = replace(runs[0], landmarks={"door": learnt((2.0, 1.0)), "lost": learnt((np.nan, np.nan))})
    write_mcap(replace(log, reference=None), [run], tmp_path / "log.mcap")
    found = Messages(tmp_path / "log.mcap")
    assert {m.transforms[0].child_frame_id for _, m in found["/tf"]} == {"base_link"}
    ((_, array),) = found[f"/{run.name}/markers"]
    assert [marker.text for marker in array.markers] == ["", "door"]
    assert [(p.x, p.y) for p in array.markers[0].points] == [(2.0, 1.0)]


def learnt(position):
    return LearntPoint(np.array(position), np.eye(2))


def test_unknown_headings_and_covariances(log, tmp_path):
    unknown = Trajectory(log.reference.t, log.reference.poses * (1.0, 1.0, np.nan), has_heading=False)
    write_mcap(replace(log, reference=unknown), [], tmp_path / "log.mcap")
    found = Messages(tmp_path / "log.mcap")["/reference/odometry"]
    assert len(found) == STEPS + 1
    assert {pose_of(m.pose.pose)[2] for _, m in found} == {0.0}
    assert not any(m.pose.covariance.any() for _, m in found)


def test_what_cannot_be_written(log, tmp_path):
    with pytest.raises(InputError, match=r"log.mcap: cannot be written: No such file"):
        write_mcap(log, [], tmp_path / "missing" / "log.mcap")
    with pytest.raises(InputError, match=r"^arc: /\S+ has the timestamp -\d+ ns, expected one from 1970 to 2038$"):
        write_mcap(replace(log, t0_ns=-(10**9)), [], tmp_path / "log.mcap")
    assert not list(tmp_path.iterdir())
