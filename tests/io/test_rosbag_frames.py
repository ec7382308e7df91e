"""Odometry and a reference from the frames of a bag, and which frames a manifest proposes."""

import math

import numpy as np
from rosbag_drive import COUNT, MS, T0, add_frames, proposed, transform

from factors import se2

ODOMETRY = np.array([(0.2 * i, 0.0, 0.1 * i) for i in range(COUNT)])


def add_tree(made, robot="base_link", world="map"):
    """Odometry counts from a frame 0.3 m behind the robot's; the correction in the map is slow."""
    for i, (x, y, heading) in enumerate(ODOMETRY):
        t = T0 + 100 * MS * i
        add_frames(made, "/tf", t, transform(made, t, "odom", "axle", (x, y, 0.0), heading))
        if i in {0, COUNT - 1}:
            add_frames(made, "/tf", t, transform(made, t, world, "odom", (5.0, i, 0.0), heading=math.pi / 2))
    add_frames(made, "/tf_static", T0, transform(made, T0, "axle", robot, (0.3, 0.0, 0.0)))


def test_a_reference_from_transforms(maker, read_drive):
    """The correction of a map is slow, odometry is fast, and the robot's middle is not where odometry counts from."""
    add_tree(maker)
    reference = read_drive(maker, reference={"topic": "/tf", "parent": "map", "child": "base_link"}).reference
    np.testing.assert_allclose(reference.t, 0.1 * np.arange(COUNT), atol=1e-9)
    corrections = np.column_stack((np.full(COUNT, 5.0), np.arange(COUNT), np.full(COUNT, math.pi / 2)))
    expected = se2.compose(se2.compose(corrections, ODOMETRY), np.array((0.3, 0.0, 0.0)))
    np.testing.assert_allclose(reference.poses, expected, atol=1e-9)


def test_transforms_that_lead_nowhere(maker, refuse_drive, refused):
    for i in range(2):
        t = T0 + i * MS
        add_frames(maker, "/tf", t, transform(maker, t, "odom", "base_link", (0.0, 0.0, 0.0)))
    tf = {"topic": "/tf", "parent": "map", "child": "base_link"}
    refuse_drive(maker, "no transforms connect base_link to map: there is no frame 'map'", reference=tf)
    options = {"odometry": {"topic": "/odom"}, "reference": {"topic": "/tf"}}
    refused(maker.path, "/tf: parent or child is missing: give two frames", reader="rosbag", options=options)


def test_odometry_from_transforms(maker, read_drive, refused):
    add_tree(maker)
    options = {"topic": "/tf", "parent": "odom", "child": "base_link"}
    moved = read_drive(maker, odometry=options).streams["odometry"]
    np.testing.assert_allclose(moved.t, 0.1 * np.arange(COUNT), atol=1e-9)
    poses = se2.compose(ODOMETRY, np.array((0.3, 0.0, 0.0)))
    moves = np.column_stack((moved.dx, moved.dy, moved.dtheta))
    np.testing.assert_allclose(moves[1:], se2.between(poses[:-1], poses[1:]), atol=1e-9)
    for changed, message in (
        ({"child": None}, "/tf: parent or child is missing: give two frames, such as map and base_link"),
        ({"child": "base_lnk"}, "there is no frame 'base_lnk': did you mean base_link?"),
        (
            {"topic": "/odom"},
            "/odom: odometry.parent or odometry.child is given, but the type is nav_msgs/msg/Odometry",
        ),
    ):
        refused(maker.path, message, reader="rosbag", options={"odometry": options | changed})


def test_frames_are_proposed_where_nothing_else_is_odometry_or_a_reference(tmp_path, bag_maker):
    with bag_maker(tmp_path / "drive") as made:
        add_tree(made, robot="base_footprint")
    found = proposed(made.path)
    assert found.options == {
        "odometry": {"topic": "/tf", "parent": "odom", "child": "base_footprint"},
        "reference": {"topic": "/tf", "parent": "map", "child": "base_footprint"},
        "base_frame": "base_footprint",
    }
    assert found.uses == {"/tf": "odometry, reference", "/tf_static": "sensor mounting"}
    (note,) = found.remarks
    assert note.startswith(
        "the pose of base_footprint in map, from /tf, is used as the reference: remove [options.reference]"
    )


def test_what_is_measured_comes_before_frames(maker, read_drive):
    add_tree(maker, world="vicon")
    made = maker
    t = T0
    made.stamped("/mocap/pose", t, "geometry_msgs/msg/PoseStamped", pose=made.pose(1.0, 2.0, 0.0))
    read_drive(maker)
    found = proposed(maker.path)
    assert found.options == {"odometry": {"topic": "/odom"}, "reference": {"topic": "/mocap/pose"}}
    assert found.remarks == [
        "odometry could also be /tf",
        "/tf has the frames axle in odom, odom in vicon: to use one as the reference, set parent and child in [options.reference]",
    ]
