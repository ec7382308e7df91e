"""Null poses of odometry, as programs publish them while they are lost: their motion is unknown."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mapped_hall import write_mapped
from refusal import refusal

from factorgraph_loc import read_log, write_native
from factorgraph_loc.io.motions import bridge_losses
from factorgraph_loc.io.readers.pose_file import read_pose_file
from factorgraph_loc.model.planar import are_null
from factorgraph_loc.sensors.motion import whole_motion
from factorgraph_loc.sensors.odometry.measurement import VelocityStream
from factors import se2

MS, T0 = 1_000_000, 1_700_000_000_000_000_000
TUM = '[options.odometry]\nfile = "odom.csv"\nformat = "tum"\n'
TABLE = (
    '[options.odometry]\nfile = "odom.csv"\nseparator = " "\nheader = false\nunits = { t = "s" }\n'
    'columns = { t = "1", x = "2", y = "3", z = "4", qx = "5", qy = "6", qz = "7", qw = "8" }\n'
)
LOST = range(10, 15)


def poses(reset=False, lost=LOST):
    """Rows of a TUM file of a robot at 1 m/s, ten a second, that is lost for half a second and perhaps begins anew."""
    rows = []
    for i in range(30):
        x = 0.1 * (i - 15 if reset and i >= 15 else i)
        rows.append(f"{0.1 * i:.1f} " + ("0 0 0 0 0 0 0" if i in lost else f"{x:.2f} 0 0 0 0 0 1"))
    return "\n".join(rows) + "\n"


@pytest.mark.parametrize("options", [TUM, TABLE])
@pytest.mark.parametrize("reset", [False, True])
def test_the_motion_is_unknown_until_the_next_pose(tmp_path, options, reset):
    log = read_log(write_mapped(tmp_path, options, odom=poses(reset)))
    stream = log.streams["odometry"]
    assert len(stream.t) == 30
    np.testing.assert_allclose(
        stream.unknown, np.where((np.arange(30) >= 10) & (np.arange(30) <= 15), 0.1, 0.0), atol=1e-9
    )
    np.testing.assert_allclose(np.sum(stream.dx), 2.9, atol=0.01)
    (message,) = [str(warning) for warning in log.warnings if warning.kind == "null_poses"]
    assert "odom.csv:11: the pose is null, the first of 5" in message
    motion = whole_motion(log, ["odometry"])
    sure, unsure = (motion.relative(motion.state(a), motion.state(a + 0.6)).covariance[0, 0] for a in (1.6, 0.9))
    assert unsure > 0.6 * log.rig.odometry.unknown_distance**2 > 10.0 * sure
    write_native(log, tmp_path / "copy")
    np.testing.assert_array_equal(read_log(tmp_path / "copy").streams["odometry"].unknown, stream.unknown)


def test_a_file_of_null_poses_is_refused(tmp_path):
    path = write_mapped(tmp_path, TUM, odom=poses(lost=range(5, 30)))
    refusal(lambda: read_log(path), "odom.csv:6: length of the quaternion is 0.0, expected 1, a unit quaternion")


def test_null_poses_of_a_trajectory(tmp_path):
    (tmp_path / "poses.tum").write_text(poses())
    path = read_pose_file(tmp_path / "poses.tum")
    assert len(path) == 25
    assert path.lost_ns.tolist() == [100 * MS * i for i in LOST]


def test_quaternions_that_are_no_rotation_are_bad_rows(tmp_path):
    text = poses(lost=()).replace("0.50 0 0 0 0 0 1", "0.50 0 0 0 0 0 2")
    refusal(lambda: read_log(write_mapped(tmp_path, TUM, odom=text)), "odom.csv:6: length", 'bad_rows = "skip"')
    log = read_log(write_mapped(tmp_path, TUM + 'bad_rows = "skip"\n'))
    assert len(log.streams["odometry"].t) == 29
    assert not log.streams["odometry"].unknown.any()


@pytest.mark.parametrize("use", ["pose", "twist"])
@pytest.mark.parametrize("variance", [0.0, 9999.0])
def test_messages_of_a_lost_robot(tmp_path, bag_maker, use, variance):
    with bag_maker(tmp_path / "drive.bag") as made:
        for i in range(20):
            lost = 10 <= i < 13
            spread = np.zeros(36)
            spread[[0, 7]] = variance if lost else 0.01
            pose = made.pose(0.1 * i, 0.0, 0.0)
            if lost and not variance:
                pose.orientation.w = 0.0
            made.stamped(
                "/odom",
                T0 + 100 * MS * i,
                "nav_msgs/msg/Odometry",
                child_frame_id="base_link",
                pose=made.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=spread),
                twist=made.make(
                    "geometry_msgs/msg/TwistWithCovariance",
                    twist=made.twist(0.0 if lost else 1.0, 0.0),
                    covariance=spread,
                ),
            )
    log = read_log(made.path, reader="rosbag", options={"odometry": {"topic": "/odom", "use": use}})
    stream = log.streams["odometry"]
    np.testing.assert_allclose(
        stream.unknown, np.where((np.arange(20) >= 10) & (np.arange(20) <= 13), 0.1, 0.0), atol=1e-9
    )
    np.testing.assert_allclose(np.sum(stream.dx), 1.9, atol=1e-6)
    assert any("/odom:11: the pose is null, the first of 3" in str(warning) for warning in log.warnings)


def test_a_variance_that_grows_is_no_loss(tmp_path, bag_maker):
    with bag_maker(tmp_path / "drive.bag") as made:
        for i in range(20):
            spread = np.zeros(36)
            spread[[0, 7]] = 5.0 * i**3
            made.stamped(
                "/odom",
                T0 + 100 * MS * i,
                "nav_msgs/msg/Odometry",
                child_frame_id="base_link",
                pose=made.make(
                    "geometry_msgs/msg/PoseWithCovariance", pose=made.pose(0.1 * i, 0, 0), covariance=spread
                ),
                twist=made.make("geometry_msgs/msg/TwistWithCovariance", twist=made.twist(1.0, 0.0), covariance=spread),
            )
    log = read_log(made.path, reader="rosbag", options={"odometry": {"topic": "/odom", "use": "twist"}})
    assert isinstance(log.streams["odometry"], VelocityStream)


@given(
    variances=st.lists(
        st.sampled_from((0.0, 0.01, 5.0, 500.0, 2000.0, 9999.0, np.inf, np.nan)), min_size=2, max_size=30
    ),
    length=st.integers(1, 29),
)
def test_later_poses_do_not_make_an_earlier_one_null(variances, length):
    both = np.column_stack((variances, np.ones(len(variances))))
    upright = np.tile((0.0, 0.0, 0.0, 1.0), (len(variances), 1))
    whole, part = are_null(upright, both), are_null(upright[:length], both[:length])
    np.testing.assert_array_equal(whole[:length], part)


def test_a_constant_placeholder_marks_no_loss():
    upright = np.tile((0.0, 0.0, 0.0, 1.0), (4, 1))
    for placeholder in (9999.0, np.inf, np.nan):
        assert not are_null(upright, np.full((4, 2), placeholder)).any()
    lost = np.array([(9999.0, 0.01), (9999.0, 0.01), (9999.0, 9999.0), (9999.0, 0.01)])
    assert are_null(upright, lost).tolist() == [False, False, True, False]


def test_losses_at_both_ends():
    t_ns = np.array([5, 6, 7]) * 100 * MS
    moves = np.array([(0.1, 0.0, 0.2), (0.1, 0.0, 0.2)])
    every, out = bridge_losses(t_ns, moves, np.array([1, 2, 7, 8, 9, 30]) * 100 * MS)
    assert (every // (100 * MS)).tolist() == [5, 6, 7, 8, 9, 30]
    np.testing.assert_allclose(out[1:5, :3], np.tile(moves[0], (4, 1)), atol=1e-9)
    np.testing.assert_allclose(out[:, 3], (0.0, 0.0, 0.0, 0.1, 0.1, 2.1))
    np.testing.assert_allclose(out[5, :3], se2.exp(np.array([se2.log(moves[0]) * 8.0]))[0], atol=1e-9)
