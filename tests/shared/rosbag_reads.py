"""Bags of each kind with odometry, reads of tags and a reference, for the tests of what is read of them and what is refused."""

import pytest

T0 = 1_700_000_000_000_000_000
MS = 1_000_000
POSES = [(0.0, 0.0, 0.5), (0.1, 0.05, 0.5), (0.2, 0.1, 0.7), (0.2, 0.1, 0.7)]
FIELDS = {
    "epc": "reads[].epc",
    "antenna": "reads[].antenna",
    "rssi": "reads[].rssi",
    "phase": "reads[].phase_degrees",
    "stamp": "reads[].first_seen_us",
}
OPTIONS = {
    "odometry": {"topic": "/odom"},
    "rfid": {"topic": "/rfid", "fields": FIELDS, "units": {"phase": "deg"}},
    "reference": {"topic": "/truth"},
}
KINDS = ["drive.bag", "mcap", "sqlite3"]


def fill(bag):
    for i, pose in enumerate(POSES):
        t = T0 + 100 * MS * i
        bag.odometry("/odom", t, pose, delay=5 * MS, v=1.0 + i)
        bag.write(
            "/truth",
            t + 7 * MS,
            "geometry_msgs/msg/PoseStamped",
            header=bag.header(t, "map"),
            pose=bag.pose(1.0 + i, 2.0, -3.0),
        )
    t = T0 + 110 * MS
    bag.reads("/rfid", t, [("E2AA", 1, -60.5, 90.0, t - 10 * MS), ("E2BB", 1, -61.0, 180.0, t)], delay=20 * MS)
    bag.reads("/rfid", t + 50 * MS, [], delay=20 * MS)
    bag.reads("/rfid", t + 100 * MS, [("E2AA", 2, -50.0, 0.0, t + 90 * MS)], delay=20 * MS)


@pytest.fixture(params=KINDS)
def bag(request, tmp_path, bag_maker):
    """A bag of each kind with odometry, reads and reference."""
    path = tmp_path / (request.param if request.param.endswith(".bag") else "drive")
    with bag_maker(path, request.param) as made:
        fill(made)
    return path


@pytest.fixture
def mcap(tmp_path, bag_maker):
    with bag_maker(tmp_path / "drive") as made:
        fill(made)
    return tmp_path / "drive"


@pytest.fixture
def read(one):
    def call(path, **changes):
        options = {k: v for k, v in (OPTIONS | changes).items() if v is not None}
        return one(path, reader="rosbag", options=options)

    return call


@pytest.fixture
def refuse(refused):
    def call(path, *fragments, **changes):
        options = {k: v for k, v in (OPTIONS | changes).items() if v is not None}
        return refused(path, *fragments, reader="rosbag", options=options)

    return call
