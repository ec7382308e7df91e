"""Bags that are damaged, cut off, or do not define what they hold, and what is no bag at all."""

import sqlite3

import pytest
from rosbag_drive import proposed
from rosbag_reads import MS, POSES, T0, fill
from rosbags.typesys import get_types_from_idl


def test_a_bag_of_ros_1_whose_recording_was_cut_off(tmp_path, bag_maker, refuse):
    path = tmp_path / "drive.bag"
    with bag_maker(path) as made:
        fill(made)
    content = path.read_bytes()
    at = content.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(content[:at] + bytes(8) + content[at + 8 :])
    refuse(path, "is not indexed", "`rosbag reindex`")


@pytest.fixture
def undefined(tmp_path, bag_maker):
    """A bag that does not define its types."""
    with bag_maker(tmp_path / "drive", "sqlite3") as made:
        fill(made)
    with sqlite3.connect(tmp_path / "drive" / "drive.db3") as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    return tmp_path / "drive"


def test_old_bags_hold_no_definitions(undefined, read, refuse):
    """Messages of ROS are known all the same, others cannot be read."""
    assert len(read(undefined, rfid=None).streams["odometry"].t) == len(POSES)
    refuse(undefined, "topic /rfid is of type shop_msgs/msg/Reads, which the bag does not define")


def test_a_topic_that_nobody_can_read_does_not_hide_the_others(undefined):
    found = proposed(undefined)
    assert set(found.options) == {"odometry", "reference"}
    assert any("/rfid is of type shop_msgs/msg/Reads, which the bag does not define" in note for note in found.remarks)


def test_a_type_of_ros_that_the_bag_defines_otherwise(tmp_path, bag_maker, refuse):
    with bag_maker(tmp_path / "drive") as made:
        fill(made)
    file = tmp_path / "drive" / "drive.mcap"
    file.write_bytes(file.read_bytes().replace(b"Quaternion orientation", b"Quaternion orientatiom"))
    refuse(file, "/odom:1: the definition of nav_msgs/msg/Odometry in the bag differs from that of ROS", rfid=None)


IDL = """\
================================================================================
IDL: shop_msgs/msg/Ping
module shop_msgs { module msg { struct Ping { string epc; double power; }; }; };
"""


def test_definitions_in_idl(tmp_path, bag_maker, read):
    """As some middlewares of ROS 2 record them."""
    with bag_maker(tmp_path / "drive") as made:
        fill(made)
        made.store.register(get_types_from_idl(IDL.partition("shop_msgs/msg/Ping\n")[2]))
        kind = "shop_msgs/msg/Ping"
        connection = made.writer.add_connection("/ping", kind, msgdef=IDL, rihs01=made.store.hash_rihs01(kind))
        message = made.make(kind, epc="E2CC", power=-55.0)
        made.writer.write(connection, T0 + 50 * MS, made.store.serialize_cdr(message, kind))
    rfid = {"topic": "/ping", "fields": {"epc": "epc", "rssi": "power"}, "antenna": "front"}
    reads = read(tmp_path / "drive", rfid=rfid).streams["rfid"]
    assert (reads.epc, reads.rssi.tolist(), reads.t.tolist()) == (["E2CC"], [-55.0], [0.1])
