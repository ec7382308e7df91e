"""Bags of all kinds, written by the tests: what is read, left out and refused."""

import sys

import numpy as np
from rosbag_reads import FIELDS, MS, POSES, T0

from factors import se2


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
    assert log.metadata["clock"].endswith("header's timestamp: /odom 0.005 s, /rfid 0.020 s, /truth 0.007 s")


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
    refuse(mcap, "needs either fields.antenna, or antenna", rfid={"topic": "/rfid", "fields": {"epc": "reads[].epc"}})


def test_headers_without_stamps(tmp_path, bag_maker, read, refuse):
    with bag_maker(tmp_path / "drive") as made:
        for i in range(3):
            made.odometry("/odom", 0, (0.1 * i, 0.0, 0.0), delay=T0 + i * MS)
    refuse(tmp_path / "drive", "/odom", "all header timestamps are 0", 'clock = "receive"', rfid=None, reference=None)
    assert read(tmp_path / "drive", rfid=None, reference=None, clock="receive").t0_ns == T0


def test_clocks_that_differ_are_told(tmp_path, bag_maker, read):
    with bag_maker(tmp_path / "drive") as made:
        for i in range(3):
            t = T0 + i * 100 * MS
            made.odometry("/odom", t, (0.1 * i, 0.0, 0.0), delay=2 * MS)
            made.reads("/rfid", t, [("E2AA", 1, -60.0, 0.0, t)], delay=3200 * MS)
    (warning,) = (w for w in read(tmp_path / "drive", reference=None).warnings if w.kind == "clocks_differ")
    assert str(warning).startswith("the clocks of /odom and /rfid differ by 3.198 s")
    received = read(tmp_path / "drive", reference=None, clock="receive")
    assert not [w for w in received.warnings if w.kind == "clocks_differ"]
    assert "/rfid 3.200 s" in received.metadata["clock"]


def test_names_and_units_of_the_messages_become_those_of_the_map(mcap, read, refuse):
    rfid = {"topic": "/rfid", "fields": FIELDS, "antennas": {"1": "front"}, "epc_case": "lower"}
    reads = read(mcap, rfid=rfid | {"units": {"phase": "deg", "rssi": 0.5}}).streams["rfid"]
    assert (reads.epc, reads.antenna) == (["e2aa", "e2bb", "e2aa"], ["front", "front", "2"])
    assert reads.rssi.tolist() == [-30.25, -30.5, -25.0]
    refuse(
        mcap, "the unit of phase is 'degrees', expected one of rad, deg", rfid=rfid | {"units": {"phase": "degrees"}}
    )


def test_without_the_library(mcap, refuse, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.interfaces", None)
    refuse(mcap, "need the library rosbags: pip install 'factorgraph-loc[ros]'")
