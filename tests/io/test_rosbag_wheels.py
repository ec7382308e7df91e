"""The wheels of a differential drive in a bag: joints, a topic for each wheel, and what the rig tells of their size."""

import math

import numpy as np
import pytest
from rosbag_drive import COUNT, MS, T0, proposed

import factorgraph_loc as fgloc


def add_wheels(made, left, right, names=("arm", "l", "r")):
    for i, (a, b) in enumerate(zip(left, right, strict=True)):
        t = T0 + 100 * MS * i
        made.stamped(
            "/joints",
            t,
            "sensor_msgs/msg/JointState",
            name=list(names),
            position=np.array((9.0, a, b)),
            velocity=np.array((9.0, 2.0 * i, 4.0 * i)),
            effort=np.zeros(0),
        )


WHEELS = {"left": "l", "right": "r", "radius": 0.1, "track": 0.4}


def test_wheels_as_a_differential_drive(maker, read_drive, one):
    turned = np.arange(COUNT)
    add_wheels(maker, 2.0 * turned, 4.0 * turned)
    moved = read_drive(maker, odometry={"topic": "/joints", "wheels": WHEELS}).streams["odometry"]
    # an arc of 0.3 m with a turn of 0.5 rad: radius 0.6 m
    expected = (0.6 * math.sin(0.5), 0.6 * (1.0 - math.cos(0.5)), 0.5)
    np.testing.assert_allclose(np.column_stack((moved.dx, moved.dy, moved.dtheta))[1:], [expected] * 4, atol=1e-12)
    options = {"odometry": {"topic": "/joints", "wheels": WHEELS, "use": "twist"}}
    speeds = one(maker.path, reader="rosbag", options=options).streams["odometry"]
    np.testing.assert_allclose(speeds.v, 0.3 * turned, atol=1e-12)
    np.testing.assert_allclose(speeds.w, 0.5 * turned, atol=1e-12)


def test_wheels_that_tell_their_speed_alone(maker, refuse_drive):
    maker.stamped(
        "/joints",
        T0,
        "sensor_msgs/msg/JointState",
        name=["l", "r"],
        position=np.zeros(0),
        velocity=np.ones(2),
        effort=np.zeros(0),
    )
    options = {"topic": "/joints", "wheels": WHEELS}
    refuse_drive(maker, "/joints:1: has 0 numbers of position for 2 joints", "odometry.use", odometry=options)


def add_topics(made, left, right, *, late=0, kind="std_msgs/msg/Float64"):
    for i, (a, b) in enumerate(zip(left, right, strict=True)):
        t = T0 + 100 * MS * i
        made.write("/left_wheel/speed", t, kind, data=float(a))
        made.write("/right_wheel/speed", t + late, kind, data=float(b))


SIZES = {"radius": 0.1, "track": 0.4, "base": 0.3}
PAIR = {"left": "data", "right": "data", "right_topic": "/right_wheel/speed", "track": 0.4}


@pytest.mark.parametrize(("unit", "size"), [("rad", 0.1), ("m", 1.0)])
def test_a_topic_for_each_wheel(maker, read_drive, unit, size):
    turned = np.arange(COUNT)
    add_topics(maker, 2.0 * turned, 4.0 * turned, late=3 * MS)
    wheels = PAIR | {"unit": unit, "radius": 0.1}
    options = {"topic": "/left_wheel/speed", "use": "twist", "wheels": wheels}
    moved = read_drive(maker, odometry=options, clock="receive").streams["odometry"]
    np.testing.assert_allclose(moved.v, 3.0 * size * turned, atol=1e-12)
    np.testing.assert_allclose(moved.w, 5.0 * size * turned, atol=1e-12)


def test_what_is_wrong_with_wheels(maker, refuse_drive, refused):
    add_topics(maker, [1.0, 1.0], [1.0, 1.0])
    topic = {"topic": "/left_wheel/speed"}
    refuse_drive(
        maker,
        "odometry.wheels needs radius [m]: set it here or in [odometry.wheels]",
        odometry=topic | {"wheels": PAIR},
    )
    for wheels, message in (
        (PAIR | {"track": None, "unit": "m"}, "odometry.wheels needs track [m]"),
        (PAIR | {"left": "speed"}, "wheel is 'speed', which std_msgs/msg/Float64 lacks; its fields: data"),
        (PAIR | {"right_topic": "/right"}, "has no topic '/right'"),
        (PAIR | {"right_topic": None}, "odometry.wheels.right_topic is missing, which std_msgs/msg/Float64 needs"),
    ):
        options = {"odometry": topic | {"wheels": {k: v for k, v in wheels.items() if v is not None}}}
        refused(maker.path, message, reader="rosbag", options=options)


def test_the_rig_tells_the_size_of_the_wheels(maker):
    add_topics(maker, np.arange(COUNT), 2.0 * np.arange(COUNT))
    maker.writer.close()
    told = {"topic": "/left_wheel/speed", "use": "twist", "wheels": PAIR | {"radius": 1.0}}
    rig = fgloc.Rig(odometry={"wheels": {"radius": 0.1, "track": 0.5}})
    log = fgloc.read_log(maker.path, reader="rosbag", options={"odometry": told}, rig=rig)
    np.testing.assert_allclose(log.streams["odometry"].v, 0.15 * np.arange(COUNT), atol=1e-12)
    np.testing.assert_allclose(log.streams["odometry"].w, 0.2 * np.arange(COUNT), atol=1e-12)
    assert log.rig == rig
    without = fgloc.read_log(maker.path, reader="rosbag", options={"odometry": told})
    assert without.rig.odometry.wheels.model_dump() == {"radius": 1.0, "track": 0.4}


def test_four_joints_that_count(maker, read_drive, refused):
    """Counts of mecanum wheels, which move the robot straight to its left."""
    names, ways = ["fl", "fr", "rl", "rr"], np.array((-1.0, 1.0, 1.0, -1.0))
    for i in range(COUNT):
        position, none = 10.0 * i * ways + 7.0, np.zeros(0)
        kind = "sensor_msgs/msg/JointState"
        maker.stamped("/wheels", T0 + 100 * MS * i, kind, name=names, position=position, velocity=none, effort=none)
    wheels = {"left": "fl", "right": "fr", "rear_left": "rl", "rear_right": "rr", "unit": 0.02} | SIZES
    moved = read_drive(maker, odometry={"topic": "/wheels", "wheels": wheels}).streams["odometry"]
    np.testing.assert_allclose(
        np.column_stack((moved.dx, moved.dy, moved.dtheta))[1:], [(0.0, 0.02, 0.0)] * 4, atol=1e-12
    )
    two = {"left": "fl", "right": "fr"} | SIZES
    options = {"odometry": {"topic": "/wheels", "wheels": two}}
    refused(maker.path, "odometry.wheels names 2 joints, expected rear_left", reader="rosbag", options=options)


def test_wheels_are_proposed_by_their_names(tmp_path, bag_maker):
    with bag_maker(tmp_path / "joints") as made:
        add_wheels(made, [0.0], [0.0], names=("left_arm", "wheel_left_joint", "wheel_right_joint"))
    found = proposed(made.path)
    wheels = {"left": "wheel_left_joint", "right": "wheel_right_joint", "radius": 0.1, "track": 0.5}
    assert found.options["odometry"] == {"topic": "/joints", "wheels": wheels}
