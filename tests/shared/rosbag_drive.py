"""Open bags with odometry, for the tests of what else a bag may hold."""

import math

import pytest

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
