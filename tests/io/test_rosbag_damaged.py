"""Bags that are damaged, cut off, or do not define what they hold, and what is no bag at all."""

import sqlite3
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbag_reads import MS, OPTIONS, POSES, T0, fill
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import parse_model
from factorgraph_loc.io.bags import file as bag_file
from factorgraph_loc.io.bags import rosbag
from factorgraph_loc.io.bags.file import open_bag
from factorgraph_loc.io.bags.manifest import propose


@pytest.mark.parametrize("keep", [0.0, 0.02, 0.3, 0.6, 0.95, 0.999])
def test_truncated_bags(bag, tmp_path, refuse, keep):
    file = bag if bag.is_file() else next(f for f in bag.iterdir() if f.suffix in {".mcap", ".db3"})
    content = file.read_bytes()
    short = tmp_path / f"short{file.suffix}"
    short.write_bytes(content[: int(keep * len(content))])
    refuse(short, f"{short}: cannot be read as a bag")


def test_a_bag_of_ros_1_whose_recording_was_cut_off(tmp_path, bag_maker, refuse):
    path = tmp_path / "drive.bag"
    with bag_maker(path) as made:
        fill(made)
    content = path.read_bytes()
    at = content.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(content[:at] + bytes(8) + content[at + 8 :])
    refuse(path, "is not indexed", "`rosbag reindex`")


def test_an_unknown_compression(tmp_path, bag_maker, refuse):
    path = tmp_path / "drive.bag"
    with bag_maker(path) as made:
        fill(made)
    path.write_bytes(path.read_bytes().replace(b"compression=none", b"compression=zpaq"))
    refuse(path, "Compression 'zpaq' is not supported")


def test_a_bag_without_its_metadata(mcap, refused, refuse):
    (mcap / "metadata.yaml").unlink()
    refused(mcap, "is a ROS 2 bag without metadata.yaml: `ros2 bag reindex", "drive.mcap, can be read without")
    refuse(mcap, "is a ROS 2 bag without metadata.yaml")


def test_a_pointer_in_place_of_a_bag(mcap, refuse):
    (mcap / "drive.mcap").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    refuse(mcap, "drive.mcap: is a pointer of Git LFS")
    refuse(mcap / "drive.mcap", "drive.mcap: is a pointer of Git LFS")


def test_no_bag_at_all(tmp_path, refuse):
    (tmp_path / "drive.txt").write_text("x")
    refuse(
        tmp_path / "drive.txt", "is not a ROS bag, expected a file .bag, .mcap, .db3, or a folder with metadata.yaml"
    )


def test_old_bags_hold_no_definitions(tmp_path, bag_maker, read, refuse):
    """Messages of ROS are known all the same, others cannot be read."""
    with bag_maker(tmp_path / "drive", "sqlite3") as made:
        fill(made)
    with sqlite3.connect(tmp_path / "drive" / "drive.db3") as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    assert len(read(tmp_path / "drive", rfid=None).streams["odometry"].t) == len(POSES)
    refuse(tmp_path / "drive", "topic /rfid is of type shop_msgs/msg/Reads, which the bag does not define")


def test_a_definition_without_end(mcap, refuse, monkeypatch):
    monkeypatch.setattr(bag_file, "DEFINITION", 100)
    refuse(mcap, "the length of the definition of nav_msgs/msg/Odometry is", "expected at most 100")


def test_a_folder_whose_metadata_is_damaged(mcap, refuse):
    (mcap / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 99}")
    refuse(mcap, "drive: cannot be read as a bag: Rosbag2 version 99 not supported")


def test_damaged_bytes_never_surprise(bag, tmp_path):
    """A bag with some bytes changed is read, or refused in one line; so is the manifest that is proposed for it."""
    file = bag if bag.is_file() else next(f for f in bag.iterdir() if f.suffix in {".mcap", ".db3"})
    content, damaged = file.read_bytes(), tmp_path / f"damaged{file.suffix}"
    options = parse_model(rosbag.Options, OPTIONS, "options")
    rng = np.random.default_rng(7)
    messages = []
    for _ in range(25):
        changed = bytearray(content)
        for place in rng.integers(len(content), size=4).tolist():
            changed[place] = int(rng.integers(256))
        damaged.write_bytes(bytes(changed))
        for read_damaged in (lambda: rosbag.read(damaged, options), lambda: proposed(damaged)):
            try:
                read_damaged()
            except InputError as error:
                messages.append(str(error))
    assert messages
    assert [message for message in messages if len(message.splitlines()) != 1] == []


def proposed(path):
    with open_bag(path) as opened:
        return propose(opened)


def test_a_topic_that_nobody_can_read_does_not_hide_the_others(tmp_path, bag_maker):
    with bag_maker(tmp_path / "drive", "sqlite3") as made:
        fill(made)
    with sqlite3.connect(tmp_path / "drive" / "drive.db3") as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    found = proposed(tmp_path / "drive")
    assert set(found.options) == {"odometry", "reference"}
    assert any("/rfid is of type shop_msgs/msg/Reads, which the bag does not define" in note for note in found.notes)


def test_a_type_of_ros_that_the_bag_defines_otherwise(tmp_path, bag_maker, refuse):
    with bag_maker(tmp_path / "drive") as made:
        fill(made)
    file = tmp_path / "drive" / "drive.mcap"
    file.write_bytes(file.read_bytes().replace(b"Quaternion orientation", b"Quaternion orientatiom"))
    refuse(file, "/odom:1: nav_msgs/msg/Odometry is defined in the bag unlike in ROS", rfid=None)


@pytest.mark.parametrize(
    ("definition", "fragment"),
    [
        ("geometry_msgs/Pose pose\nfloat64[36] variance", "has no attribute 'covariance'"),
        ("geometry_msgs/Pose pose\nfloat64[9] covariance", "out of bounds"),
        ("geometry_msgs/Pose pose\nstring covariance", "could not convert string"),
    ],
)
def test_a_start_that_the_bag_defines_otherwise(definition, fragment, tmp_path, bag_maker, refuse):
    kind = "geometry_msgs/msg/PoseWithCovariance"
    with bag_maker(tmp_path / "drive") as made:
        fill(made)
        made.store = get_typestore(Stores.ROS2_HUMBLE)
        del made.store.fielddefs[kind]
        made.store.register(get_types_from_msg(definition, kind))
        name = definition.split()[-1]
        value = "much" if "string" in definition else np.ones(36 if "36" in definition else 9)
        told = made.make(kind, pose=made.pose(1.0, 2.0, 0.0), **{name: value})
        made.write("/initialpose", T0, f"{kind}Stamped", header=made.header(T0), pose=told)
    start = {"topic": "/initialpose"}
    refuse(made.path, f"/initialpose:1: {kind}Stamped is defined", fragment, start=start, rfid=None)


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


def test_a_topic_whose_name_is_no_text():
    connection = SimpleNamespace(topic=b"/odom", msgtype="nav_msgs/msg/Odometry", msgcount=1)
    with pytest.raises(InputError, match=r"^log\.db3: the name or the type of a topic is not text$"):
        bag_file.Bag(Path("log.db3"), SimpleNamespace(connections=[connection]))
