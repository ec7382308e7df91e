"""Bags of all kinds, written by the tests: what is read, left out and refused."""

import sqlite3
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import parse_model
from factorgraph_loc.io.bags import file as bag_file
from factorgraph_loc.io.bags import rosbag
from factorgraph_loc.io.bags.file import open_bag
from factorgraph_loc.io.bags.manifest import propose
from factorgraph_loc.io.readers import load
from factors import se2

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


def test_what_is_read(bag, read):
    log = read(bag)
    assert (log.name, log.t0_ns) == ("drive", T0)
    moved = log.streams["odometry"]
    np.testing.assert_allclose(moved.t, (0.0, 0.1, 0.2, 0.3), atol=1e-9)
    moves = np.column_stack((moved.dx, moved.dy, moved.dtheta))
    np.testing.assert_array_equal(moves[0], 0.0)
    np.testing.assert_allclose(se2.compose(np.array(POSES[0]), moves[1]), POSES[1], atol=1e-12)
    np.testing.assert_allclose(moves[1:], se2.between(np.array(POSES[:-1]), np.array(POSES[1:])), atol=1e-12)
    np.testing.assert_allclose(log.reference.poses[2], (3.0, 2.0, -3.0), atol=1e-12)
    reads = log.streams["rfid"]
    assert (reads.epc, reads.antenna) == (["E2AA", "E2BB", "E2AA"], ["1", "1", "2"])
    np.testing.assert_allclose(reads.t, (0.16, 0.16, 0.25), atol=1e-9)  # known to be over after the pause
    np.testing.assert_allclose(reads.age, (0.06, 0.05, 0.05), atol=1e-9)
    np.testing.assert_allclose(reads.phase, (np.pi / 2, np.pi, 0.0))
    assert reads.rssi.tolist() == [-60.5, -61.0, -50.0]
    assert np.isnan(reads.frequency).all()
    assert log.metadata["clock"].endswith("(median): /odom 0.005 s, /rfid 0.020 s, /truth 0.007 s")


def test_a_file_within_a_folder_is_a_bag_of_its_own(mcap, read):
    assert len(read(mcap / "drive.mcap").streams["odometry"].t) == len(POSES)


def test_messages_as_rounds_tell_of_antennas_that_read_nothing(mcap, read):
    fields = {"epc": "reads[].raw", "rssi": "reads[].rssi"}
    log = read(mcap, rfid={"topic": "/rfid", "fields": fields, "antenna": "front", "rounds": "message"})
    reads = log.streams["rfid"]
    assert reads.epc == ["E2AA", "E2BB", "", "E2AA"]
    assert set(reads.antenna) == {"front"}
    np.testing.assert_allclose(reads.t, (0.11, 0.11, 0.16, 0.21), atol=1e-9)


def test_the_time_of_receipt_may_count(mcap, read):
    log = read(mcap, clock="receive", rfid=None)
    assert log.t0_ns == T0 + 5 * MS
    np.testing.assert_allclose(log.reference.t[0], 0.002, atol=1e-9)
    late = read(mcap, reference={"topic": "/truth", "clock": "receive"})
    assert (late.t0_ns, round(float(late.reference.t[0]), 9)) == (T0, 0.007)


def test_a_bag_without_a_manifest_says_what_to_do(bag, refused):
    refused(bag, "is a ROS bag", "fgloc manifest")
    refused(bag.parent / "gone.bag", "is neither a file, nor a folder")


@pytest.mark.usefixtures("mcap")
def test_a_manifest_beside_the_bag(tmp_path):
    text = 'title = "t"\nreader = "rosbag"\nlicence = "l"\norigin = "o"\npath = "drive"\n'
    text += '[options.odometry]\ntopic = "/odom"\nuse = "twist"\n'
    (tmp_path / "run.toml").write_text(text)
    (log,) = load(str(tmp_path / "run.toml"))
    assert log.name == "drive"
    assert log.streams["odometry"].v.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert load(str(tmp_path))[0].name == "drive"


def test_a_topic_that_is_missing(mcap, refuse):
    refuse(mcap, "has no topic '/odo': did you mean /odom?", odometry={"topic": "/odo"})


def test_a_topic_of_another_type(mcap, refuse):
    refuse(mcap, "topic /rfid is of type shop_msgs/msg/Reads", "nav_msgs/msg/Odometry", odometry={"topic": "/rfid"})
    refuse(mcap, "topic /rfid is of type shop_msgs/msg/Reads", "PoseStamped", reference={"topic": "/rfid"})


def test_a_topic_without_messages(tmp_path, bag_maker, refuse):
    with bag_maker(tmp_path / "drive") as made:
        fill(made)
        made.topic("/silent", "geometry_msgs/msg/PoseStamped")
    refuse(tmp_path / "drive", "topic /silent", "has no messages", reference={"topic": "/silent"})


def test_a_field_that_the_message_lacks(mcap, refuse):
    fields = FIELDS | {"epc": "reads[].tag"}
    message = refuse(
        mcap, "/rfid: epc is 'reads[].tag', which shop_msgs/msg/Reads lacks", rfid={"topic": "/rfid", "fields": fields}
    )
    assert message.endswith(
        "its fields: header.stamp, header.frame_id, reads[].epc, reads[].raw, reads[].antenna, reads[].rssi, "
        "reads[].phase_degrees, reads[].first_seen_us"
    )


def test_an_antenna_that_is_not_told(mcap, refuse):
    refuse(
        mcap, "expected either fields.antenna, or antenna", rfid={"topic": "/rfid", "fields": {"epc": "reads[].epc"}}
    )


def test_degrees_for_radians(mcap, refuse):
    refuse(
        mcap,
        "drive /rfid:1: phase is 90.0, expected a finite number of radians",
        rfid={"topic": "/rfid", "fields": FIELDS},
    )


def test_stamps_that_go_back(tmp_path, bag_maker, refuse):
    with bag_maker(tmp_path / "drive") as made:
        for i, t in enumerate((0, 100, 50)):
            made.odometry("/odom", T0 + t * MS, (0.0, 0.0, 0.0), delay=i * 300 * MS)
    refuse(tmp_path / "drive", "drive /odom:3: time is", "not before that of the row before", rfid=None, reference=None)


def test_headers_without_stamps(tmp_path, bag_maker, read, refuse):
    with bag_maker(tmp_path / "drive") as made:
        for i in range(3):
            made.odometry("/odom", 0, (0.1 * i, 0.0, 0.0), delay=T0 + i * MS)
    refuse(tmp_path / "drive", "/odom", "all headers are 0", 'clock = "receive"', rfid=None, reference=None)
    assert read(tmp_path / "drive", rfid=None, reference=None, clock="receive").t0_ns == T0


def test_clocks_that_differ_are_told(tmp_path, bag_maker, read):
    with bag_maker(tmp_path / "drive") as made:
        for i in range(3):
            t = T0 + i * 100 * MS
            made.odometry("/odom", t, (0.1 * i, 0.0, 0.0), delay=2 * MS)
            made.reads("/rfid", t, [("E2AA", 1, -60.0, 0.0, t)], delay=3200 * MS)
    (warning,) = (w for w in read(tmp_path / "drive", reference=None).warnings if "clocks" in w)
    assert warning.startswith("the clocks of /odom and /rfid differ by 3.198 s")
    received = read(tmp_path / "drive", reference=None, clock="receive")
    assert not [w for w in received.warnings if "clocks" in w]
    assert "/rfid 3.200 s" in received.metadata["clock"]


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


def test_names_and_units_of_the_messages_become_those_of_the_map(mcap, read, refuse):
    rfid = {"topic": "/rfid", "fields": FIELDS, "antennas": {"1": "front"}, "epc_case": "lower"}
    reads = read(mcap, rfid=rfid | {"units": {"phase": "deg", "rssi": 0.5}}).streams["rfid"]
    assert (reads.epc, reads.antenna) == (["e2aa", "e2bb", "e2aa"], ["front", "front", "2"])
    assert reads.rssi.tolist() == [-30.25, -30.5, -25.0]
    refuse(mcap, "units.phase is 'degrees', expected one of rad, deg", rfid=rfid | {"units": {"phase": "degrees"}})


def test_old_bags_hold_no_definitions(tmp_path, bag_maker, read, refuse):
    """Messages of ROS are known all the same, others cannot be read."""
    with bag_maker(tmp_path / "drive", "sqlite3") as made:
        fill(made)
    with sqlite3.connect(tmp_path / "drive" / "drive.db3") as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    assert len(read(tmp_path / "drive", rfid=None).streams["odometry"].t) == len(POSES)
    refuse(tmp_path / "drive", "topic /rfid is of type shop_msgs/msg/Reads, which the bag does not define")


def test_types_are_compiled_once_however_often_a_bag_is_read(mcap, monkeypatch):
    """For the list of an option a bag is read once for each value."""
    compiled = []

    def counted(text, kind):
        compiled.append(kind)
        return get_types_from_msg(text, kind)

    monkeypatch.setattr("rosbags.typesys.get_types_from_msg", counted)
    bag_file._store.cache_clear()
    logs = load(str(mcap), reader="rosbag", options=OPTIONS | {"base_frame": [f"base{i}" for i in range(5)]})
    assert len(logs) == 5
    assert sorted(compiled) == sorted(set(compiled))
    assert "nav_msgs/msg/Odometry" in compiled


def test_a_definition_without_end(mcap, refuse, monkeypatch):
    monkeypatch.setattr(bag_file, "DEFINITION", 100)
    refuse(mcap, "the length of the definition of nav_msgs/msg/Odometry is", "expected at most 100")


def test_without_the_library(mcap, refuse, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.interfaces", None)
    refuse(mcap, "need the library rosbags: pip install 'factorgraph-loc[ros]'")


def test_a_folder_whose_metadata_is_damaged(mcap, refuse):
    (mcap / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 99}")
    refuse(mcap, "drive: cannot be read as a bag: Rosbag2 version 99 not supported")


def test_a_mapping_without_odometry(mcap, refuse):
    refuse(mcap, "odometry is missing", odometry=None)


def test_a_stamp_that_is_no_number(mcap, refuse):
    fields = FIELDS | {"stamp": "header.frame_id"}
    refuse(mcap, "drive /rfid:1: stamp is '', expected a time, or a number", rfid={"topic": "/rfid", "fields": fields})


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
