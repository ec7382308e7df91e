"""Open bags with odometry, for the tests of what else a bag may hold."""

import math

import numpy as np
import pytest

from factorgraph_loc.io.bags.file import open_bag
from factorgraph_loc.io.bags.manifest import propose

T0 = 1_700_000_000_000_000_000
MS = 1_000_000
COUNT = 5


@pytest.fixture(params=["drive.bag", "drive"])
def maker(request, tmp_path, bag_maker, monkeypatch):
    """An open bag of each version with odometry."""
    monkeypatch.setenv("FGLOC_CACHE", str(tmp_path / "cache"))
    made = bag_maker(tmp_path / request.param)
    for i in range(COUNT):
        made.odometry("/odom", T0 + 100 * MS * i, (0.1 * i, 0.0, 0.0))
    return made


@pytest.fixture
def read_drive(one):
    def call(made, **options):
        made.writer.close()
        return one(made.path, reader="rosbag", options={"odometry": {"topic": "/odom"}, **options})

    return call


@pytest.fixture
def refuse_drive(refused):
    def call(made, *fragments, **options):
        made.writer.close()
        return refused(made.path, *fragments, reader="rosbag", options={"odometry": {"topic": "/odom"}, **options})

    return call


def transform(made, t_ns, parent, child, place, heading=0.0, quaternion=None):
    turn = quaternion or (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
    moved = made.make(
        "geometry_msgs/msg/Transform",
        translation=made.vector("Vector3", *place),
        rotation=made.vector("Quaternion", *turn),
    )
    header = made.header(t_ns, parent)
    return made.make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=moved)


def add_frames(made, topic, t_ns, *transforms):
    made.write(topic, t_ns, "tf2_msgs/msg/TFMessage", transforms=list(transforms))


def add_imu(made, rates, topic="/imu", t_ns=T0):
    """A message of an IMU for each of ``rates`` (N, 3), ten a second."""
    for i, rate in enumerate(rates):
        turn, spin = made.vector("Quaternion", 0.0, 0.0, 0.0, 1.0), made.vector("Vector3", *rate)
        told = {"orientation": turn, "angular_velocity": spin, "linear_acceleration": spin}
        told |= {f"{name}_covariance": np.zeros(9) for name in tuple(told)}
        made.stamped(topic, t_ns + 100 * MS * i, "sensor_msgs/msg/Imu", **told)


def proposed(path):
    """What a manifest of a bag would say."""
    with open_bag(path) as bag:
        return propose(bag)
