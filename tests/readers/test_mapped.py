"""A folder of other programs' tables, read by a manifest."""

import json

import numpy as np
import pytest

from factorgraph_loc.column_mapping import iso_nanoseconds
from factorgraph_loc.log import IncrementStream, VelocityStream

ODOMETRY = "time_ms;speed;turn\n1000;1,8;90\n1500;1,8;0\n2500;0;0\n"
READS = """\
// Antennas connected = 1,2
// Timestamp, EPC, TID, Antenna, RSSI, Frequency, Hostname, PhaseAngle, DopplerFrequency, CRHandle
1970-01-01T01:00:01.1000000+01:00,e2001,,1,-60.5,866.3,reader,1.5,0,
1970-01-01T01:00:01.2000000+01:00,e2002,,2,-70,866.3,reader,0.5,0,
1970-01-01T01:00:02.1000005+01:00,e2001,,1,-61,867.5,reader,,0,
"""
TRUTH = "stamp,east,north,yaw\n1,100,0,0\n2,200,0,90\n"
MANIFEST = """\
title = "a hall"
reader = "mapped"
path = "run"
licence = "none stated"
origin = "made by hand"

[options.odometry]
file = "wheels.csv"
separator = ";"
decimal = ","
columns = { t = "time_ms", v = "speed", w = "turn" }
units = { t = "ms", v = "km/h", w = "deg/s" }

[options.rfid]
file = "reads.csv"
preset = "impinj_itemtest"
epc_case = "upper"
antennas = { 1 = "left", 2 = "right" }

[options.reference]
file = "truth.csv"
columns = { t = "stamp", x = "east", y = "north", heading = "yaw" }
units = { t = "s", x = "cm", y = "cm", heading = "deg" }
"""


@pytest.fixture
def hall(tmp_path):
    """A manifest with its folder: odometry of a spreadsheet, ItemTest's reads, a reference in centimetres."""
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "wheels.csv").write_text(ODOMETRY)
    (folder / "reads.csv").write_text(READS)
    (folder / "truth.csv").write_text(TRUTH)
    manifest = tmp_path / "hall.toml"
    manifest.write_text(MANIFEST)
    return manifest


@pytest.fixture
def with_options(hall):
    """The manifest with other options in place of all of its own."""

    def change(text):
        hall.write_text(MANIFEST.partition("[options")[0] + text)
        return hall

    return change


WHEELS = """
[options.odometry]
file = "wheels.csv"
separator = ";"
decimal = ","
columns = { t = "time_ms", v = "speed", w = "turn" }
units = { t = "ms" }
"""


def test_files_of_three_programs_are_one_log(hall, one):
    log = one(hall)
    assert log.name == "hall"
    assert log.t0_ns == 1_000_000_000
    odometry, rfid = log.streams["odometry"], log.streams["rfid"]
    assert isinstance(odometry, VelocityStream)
    np.testing.assert_allclose(odometry.t, (0.0, 0.5, 1.5))
    np.testing.assert_allclose(odometry.v, (0.5, 0.5, 0.0))
    np.testing.assert_allclose(odometry.w, (np.pi / 2, 0.0, 0.0))
    assert list(rfid.epc) == ["E2001", "E2002", "E2001"]
    assert list(rfid.antenna) == ["left", "right", "left"]
    np.testing.assert_allclose(rfid.t - rfid.age, (0.1, 0.2, 1.1000005), atol=1e-12)
    np.testing.assert_allclose(rfid.frequency, (866.3e6, 866.3e6, 867.5e6))
    np.testing.assert_allclose(rfid.phase, (1.5, 0.5, np.nan))
    np.testing.assert_allclose(log.reference.poses, ((1.0, 0.0, 0.0), (2.0, 0.0, np.pi / 2)))


def test_events_of_an_r700_as_json_lines(hall, with_options, one):
    def event(t, antenna):
        inventory = {"epcHex": "E2001", "antennaPort": antenna, "peakRssiCdbm": -5234, "phaseAngle": 90.0}
        return {"timestamp": f"1970-01-01T00:00:0{t}Z", "tagInventoryEvent": inventory | {"frequency": 866300}}

    lines = [event("1.5", 1), {"timestamp": "1970-01-01T00:00:02Z", "inventoryStatusEvent": {}}, event("2.25", 2)]
    (hall.parent / "run" / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    log = one(with_options(f'{WHEELS}\n[options.rfid]\nfile = "events.jsonl"\npreset = "impinj_iot"\n'))
    rfid = log.streams["rfid"]
    np.testing.assert_allclose(rfid.t, (0.5, 1.25))
    np.testing.assert_allclose((rfid.rssi[0], rfid.phase[0], rfid.frequency[0]), (-52.34, np.pi / 2, 866.3e6))
    assert list(rfid.antenna) == ["1", "2"]
    assert any("1 objects that are no reads are left out" in line for line in log.warnings)


def test_reports_of_sllurp_with_several_reads_in_a_row(hall, with_options, one):
    report = {
        "EPC": "b'e2001'",
        "AntennaID": 1,
        "PeakRSSI": -50,
        "ChannelIndex": 3,
        "ImpinjRFPhaseAngle": 1024,
        "FirstSeenTimestampUTC": 1_500_000,
        "LastSeenTimestampUTC": 1_900_000,
        "TagSeenCount": 4,
    }
    single = {**report, "FirstSeenTimestampUTC": 1_200_000, "LastSeenTimestampUTC": 1_200_000, "TagSeenCount": 1}
    (hall.parent / "run" / "tags.json").write_text(json.dumps([report, single]) + "\n")  # a report holds a list
    log = one(
        with_options(
            f'{WHEELS}\n[options.rfid]\nfile = "tags.json"\npreset = "sllurp_reports"\nround_gap = 0.1\n'
            "channels = { first = 902.75, step = 0.5 }\n"
        )
    )
    rfid = log.streams["rfid"]
    np.testing.assert_allclose(rfid.t - rfid.age, (0.2, 0.5, 0.9))
    np.testing.assert_allclose(rfid.rssi, (-50.0, -50.0, np.nan))
    np.testing.assert_allclose(rfid.phase[:2], np.pi / 2)
    np.testing.assert_allclose(rfid.frequency[:2], 903.75e6)
    assert set(rfid.epc) == {"e2001"}
    assert any("2 reads between the first and the last" in line for line in log.warnings)


def test_rows_of_sllurp_log_and_rounds_that_another_file_tells(hall, with_options, one):
    folder = hall.parent / "run"
    (folder / "log.csv").write_text("timestamp,reader,antenna,rssi,epc\n1.15,r:5084,1,-60,aa\n1.12,r:5084,1,-61,bb\n")
    (folder / "rounds.csv").write_text("end,port,took\n1.2,1,200\n1.4,2,200\n")
    log = one(
        with_options(
            f'{WHEELS}\n[options.rfid]\nfile = "log.csv"\npreset = "sllurp_log"\nclock_offset = 0.01\n'
            '[options.inventories]\nfile = "rounds.csv"\ncolumns = { t = "end", antenna = "port", duration = "took" }\n'
            'units = { t = "s", duration = "ms" }\n'
        )
    )
    rfid = log.streams["rfid"]
    assert list(rfid.epc) == ["bb", "aa", ""]
    np.testing.assert_allclose(rfid.t, (0.2, 0.2, 0.4))
    np.testing.assert_allclose(rfid.age[:2], (0.07, 0.04), atol=1e-9)


@pytest.mark.parametrize(
    ("rows", "columns"),
    [
        (
            "1 0 0 0 0 0 1\n2 0 1 0 0 {h} {h}\n3 0 2 0 0 {h} {h}\n",
            't="1", x="2", y="3", qx="4", qy="5", qz="6", qw="7"',
        ),
        ("1 0 0 0\n2 0 1 90\n3 0 2 90\n", 't="1", x="2", y="3", heading="4"'),
    ],
    ids=["quaternions", "headings"],
)
def test_poses_are_odometry_by_the_motion_between_them(hall, with_options, one, rows, columns):
    (hall.parent / "run" / "odom.txt").write_text("# poses\n" + rows.format(h=np.sqrt(0.5)))
    units = 't = "s", heading = "deg"' if "heading" in columns else 't = "s"'
    log = one(
        with_options(
            '[options.odometry]\nfile = "odom.txt"\nseparator = " "\nheader = false\n'
            f"columns = {{ {columns} }}\nunits = {{ {units} }}\n"
        )
    )
    odometry = log.streams["odometry"]
    assert isinstance(odometry, IncrementStream)
    np.testing.assert_allclose(odometry.dx, (0.0, 0.0, 1.0), atol=1e-12)
    np.testing.assert_allclose(odometry.dy, (0.0, 1.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(odometry.dtheta, (0.0, np.pi / 2, 0.0), atol=1e-9)


def test_ticks_of_two_wheels_are_metres_by_a_factor(hall, with_options, one):
    (hall.parent / "run" / "ticks.csv").write_text("t,l,r\n0,100,100\n1,1100,1100\n2,1100,1257.0796326794897\n")
    log = one(
        with_options(
            '[options.odometry]\nfile = "ticks.csv"\ntrack = 0.1\ncolumns = { t = "t", left = "l", right = "r" }\n'
            'units = { t = "s", left = 0.001, right = 0.001 }\n'
        )
    )
    odometry = log.streams["odometry"]
    np.testing.assert_allclose(odometry.dx[1], 1.0)
    np.testing.assert_allclose(odometry.dtheta, (0.0, 0.0, np.pi / 2))


def test_a_gyro_by_its_three_axes(hall, with_options, one, refused):
    (hall.parent / "run" / "gyro.csv").write_text("t,a,b,c\n1,10,20,90\n2,0,30,0\n")
    options = f"""{WHEELS}
[options.imu]
file = "gyro.csv"
columns = {{ t = "t", wx = "a", wy = "b", wz = "c" }}
units = {{ t = "s", wx = "deg/s", wy = "deg/s", wz = "deg/s" }}
"""
    np.testing.assert_allclose(np.degrees(one(with_options(options)).streams["imu"].w), (90.0, 0.0))
    down = one(with_options(options + 'axes = "x -z y"\n'))
    np.testing.assert_allclose(np.degrees(down.streams["imu"].w), (20.0, 30.0))
    one_axis = options.replace('wx = "a", wy = "b", wz = "c"', 'w = "c"').replace('wx = "deg/s", wy = "deg/s", wz', "w")
    refused(with_options(one_axis + 'axes = "optical"\n'), "axes and mounting are for rates about three axes")


def test_a_reference_in_space_by_mapping(hall, with_options, one, refused):
    rows = "1,0,-9,0,0,0,0,1\n2,1,-4,2,0,0,0,1\n3,2,-1,4,0,0,0,1\n"
    (hall.parent / "run" / "space.csv").write_text("t,x,y,z,qx,qy,qz,qw\n" + rows)
    names = ", ".join(f'{name} = "{name}"' for name in ("t", "x", "y", "z", "qx", "qy", "qz", "qw"))
    options = f"""{WHEELS}
[options.reference]
file = "space.csv"
columns = {{ {names} }}
units = {{ t = "s" }}
"""
    refused(with_options(options), "space.csv: poses rise by 4.0 m, expected a robot on a floor")
    log = one(with_options(options + 'axes = "optical"\n'))
    np.testing.assert_allclose(log.reference.poses, [(0, 0, 0), (2, -1, 0), (4, -2, 0)], atol=1e-12)
    assert any("poses rise by 8.00 m" in warning for warning in log.warnings)


def test_other_sensors_by_mapping(hall, with_options, one):
    folder = hall.parent / "run"
    (folder / "gyro.csv").write_text("t,z\n1,90\n2,0\n")
    (folder / "beacons.csv").write_text("t,id,cm\n1.2,A,150\n")
    (folder / "pixels.csv").write_text("t,id,u,v\n1.2,A,10,20\n")
    (folder / "images.csv").write_text("t,name\n1.3,a.jpg\n1.4,b.jpg\n")
    (folder / "pictures").mkdir()
    (folder / "pictures" / "a.jpg").write_bytes(b"")
    log = one(
        with_options(
            f"""{WHEELS}
[options.imu]
file = "gyro.csv"
columns = {{ t = "t", w = "z" }}
units = {{ t = "s", w = "deg/s" }}
[options.bearing_range]
file = "beacons.csv"
columns = {{ t = "t", landmark = "id", range = "cm" }}
units = {{ t = "s", range = "cm" }}
[options.sightings]
file = "pixels.csv"
columns = {{ t = "t", landmark = "id", u = "u", v = "v" }}
units = {{ t = "s" }}
[options.camera]
file = "images.csv"
folder = "pictures"
columns = {{ t = "t", file = "name" }}
units = {{ t = "s" }}
"""
        )
    )
    np.testing.assert_allclose(log.streams["imu"].w, (np.pi / 2, 0.0))
    np.testing.assert_allclose(log.streams["bearing_range"].range, 1.5)
    assert np.isnan(log.streams["bearing_range"].bearing).all()
    assert log.streams["sightings"].u.tolist() == [10.0]
    assert [file.name for file in log.streams["camera"].file] == ["a.jpg"]
    assert any("1 of 2 images are missing" in line for line in log.warnings)


@pytest.mark.parametrize("form", ["tum", "kitti"])
def test_a_reference_of_a_data_set(hall, with_options, one, form):
    folder = hall.parent / "run"
    (folder / "poses.txt").write_text(
        {
            "tum": "# t x y z q\n1 0 0 0 0 0 0 1\n2 3 1 0 0 0 0.7071068 0.7071068\n",
            # of a camera: x right, y down, z ahead; turned left by a quarter after 3 m ahead and 1 m to the left
            "kitti": "1 0 0 0 0 1 0 0 0 0 1 0\n0 0 -1 -1 0 1 0 0 1 0 0 3\n",
        }[form]
    )
    (folder / "times.txt").write_text("1.0\n2.0\n")
    times = 'times = "times.txt"\n' if form == "kitti" else ""
    log = one(with_options(f'{WHEELS}\n[options.reference]\nfile = "poses.txt"\nformat = "{form}"\n{times}'))
    np.testing.assert_allclose(log.reference.t, (0.0, 1.0))
    np.testing.assert_allclose(log.reference.poses, ((0, 0, 0), (3, 1, np.pi / 2)), atol=1e-6)


def test_stamps_keep_their_nanoseconds():
    assert iso_nanoseconds("2026-04-09T14:24:20.255000001-05:00") == 1775762660255000001
    assert iso_nanoseconds("2026-04-09 19:24:20.255") == 1775762660255000000
    assert iso_nanoseconds("2026-04-09T19:24:20") == 1775762660000000000


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        ('t = "time_ms"', 't = "time"', ("wheels.csv:1", "no column 'time'", "time_ms, speed, turn")),
        ('t = "ms", v', "v", ("wheels.csv", "unit of t is None", "iso")),
        ('w = "deg/s" }', 'w = "degrees" }', ("wheels.csv", "unit of w is 'degrees'", "rad/s, deg/s")),
        (', w = "turn" }', " }", ("wheels.csv", "maps t, v, expected t, v, w or")),
        ('v = "speed"', 'speed = "speed"', ("wheels.csv", "no field 'speed'")),
        ('units = { t = "ms", v', 'units = { t = "ms", rssi', ("units.rssi", "no field")),
        ('file = "truth.csv"', 'file = "../../truth.csv"', ("leaves its folder",)),
        ('file = "truth.csv"', 'file = "trut.csv"', ("trut.csv: cannot be read",)),
        ('preset = "impinj_itemtest"', 'preset = "impinj"', ("options of reader mapped", "rfid.preset", "impinj_iot")),
        ('"impinj_itemtest"', '"impinj_itemtest"\nantenn = "1"', ("unknown key rfid.antenn: did you mean antenna",)),
        ('"impinj_itemtest"', '"impinj_itemtest"\nchannels = [866.3]', ("channels", "together")),
        (', heading = "yaw" }', " }", ("truth.csv", "units.heading belongs to no field")),
        ('decimal = ","', 'decimal = "."', ("wheels.csv:2", "speed is '1,8', expected a number")),
    ],
)
def test_a_wrong_manifest(hall, refused, old, new, fragments):
    assert old in MANIFEST
    hall.write_text(MANIFEST.replace(old, new))
    refused(hall, *fragments)


@pytest.mark.parametrize(
    ("file", "content", "fragments"),
    [
        ("wheels.csv", "", ("wheels.csv: holds no rows",)),
        ("wheels.csv", ODOMETRY.splitlines()[0] + "\n", ("wheels.csv: holds no rows",)),
        ("wheels.csv", ODOMETRY + "9000;1", ("wheels.csv:5", "'9000,1'", "3 values")),
        ("wheels.csv", ODOMETRY + "yesterday;1;0\n", ("wheels.csv:5", "time_ms is 'yesterday'", "a number of ms")),
        ("wheels.csv", ODOMETRY + "2000;1;0\n", ("wheels.csv:5", "2000000000 ns", "not before")),
        ("wheels.csv", ODOMETRY + "3000;;0\n", ("wheels.csv:5", "speed", "finite")),
        (
            "reads.csv",
            READS + "4/9/2026 2:15 PM,e2001,,1,-60,866.3,r,1,0,\n",
            ("reads.csv:6", "Timestamp", "2026-01-31"),
        ),
        ("reads.csv", READS.replace(",e2002,", ",,"), ("reads.csv:4", "EPC is ''", "the EPC of a tag")),
        ("reads.csv", READS.replace(",1.5,", ",150,"), ("reads.csv:3", "phase is 150.0", "radians")),
        ("reads.csv", READS.replace("866.3", "866300000"), ("reads.csv:3", "frequency", "Hz")),
        ("reads.csv", '"' + READS, ("reads.csv",)),
    ],
)
def test_a_wrong_file(hall, refused, file, content, fragments):
    (hall.parent / "run" / file).write_text(content)
    refused(hall, *fragments)


@pytest.mark.parametrize(
    ("content", "fragments"),
    [
        ('{"timestamp": "1970', ("events.jsonl:1: is not JSON",)),
        ("12\n", ("events.jsonl:1", "an object")),
        ('{"time": 1, "tag": {"epc": "A"}}\n', ("no object has 'timestamp', the first has tag.epc, time",)),
        ('{"timestamp": [1], "epc": "A", "antenna": 1}\n', ("events.jsonl:1", "timestamp is [1]")),
    ],
)
def test_wrong_json_lines(hall, with_options, refused, content, fragments):
    (hall.parent / "run" / "events.jsonl").write_text(content)
    manifest = with_options(f'{WHEELS}\n[options.rfid]\nfile = "events.jsonl"\npreset = "sllurp_log"\n')
    refused(manifest, *fragments)


def test_a_reference_of_another_time_is_told(hall, one):
    truth = hall.parent / "run" / "truth.csv"
    truth.write_text(TRUTH.replace("\n1,", "\n100001,").replace("\n2,", "\n100002,"))
    assert any("do not overlap" in line and "clock_offset" in line for line in one(hall).warnings)


def test_a_folder_that_is_not_beside_its_manifest(hall, refused, monkeypatch):
    monkeypatch.delenv("FGLOC_DATA", raising=False)
    hall.write_text(MANIFEST.replace('"run"', '"rnu"'))
    refused(hall, "hall.toml (which has no rnu beside it): needs the data folder")


def test_reads_in_several_files(hall, one, refused):
    folder = hall.parent / "run"
    expected = one(hall).streams["rfid"]
    head, first, last = READS.partition("1970-01-01T01:00:02")
    (folder / "reads.csv").unlink()
    (folder / "reads-b.csv").write_text(head)
    (folder / "reads-a.csv").write_text("".join(READS.splitlines(keepends=True)[:2]) + first + last)
    hall.write_text(MANIFEST.replace("reads.csv", "reads-*.csv"))
    found = one(hall).streams["rfid"]
    assert found.epc == expected.epc
    np.testing.assert_array_equal(found.t, expected.t)
    (folder / "reads-c.csv").write_text(READS + "soon,e2001,,1,-60,866.3,r,1,0,\n")
    refused(hall, "reads-c.csv:6", "soon")
    hall.write_text(MANIFEST.replace("reads.csv", "log-*.csv"))
    refused(hall, "log-*.csv", "files that are there")
    hall.write_text(MANIFEST.replace("reads.csv", "../*.csv"))
    refused(hall, "leaves its folder")


READERS = "\n".join(
    f"""
[options.readers.{name}]
file = "{name}.txt"
antenna = "{name}"
separator = " "
header = false
columns = {{ t = "8", epc = "2", frequency = "4", phase = "5", rssi = "6" }}
units = {{ t = "us", frequency = "MHz", phase = "deg" }}
"""
    for name in ("first", "second", "third")
)


def test_three_readers_of_a_recorded_robot(data_root, tmp_path, one):
    """The same reads as the reader that was written for this data set gives within its span, to the last digit."""
    (tmp_path / "aisle.toml").write_text(
        MANIFEST.partition("[options")[0].replace('"run"', '"rfid_aisle/run13"')
        + '[options.odometry]\nfile = "reference_pose.txt"\nseparator = " "\nheader = false\nunits = { t = "s" }\n'
        + 'columns = { t = "4", x = "1", y = "2", heading = "3" }\n'
        + READERS
    )
    log = one(tmp_path / "aisle.toml", data_root=data_root)
    expected = one("rfid-aisle-run13", data_root=data_root)
    theirs, ours = expected.streams["rfid"], log.streams["rfid"]
    shift = (log.t0_ns - expected.t0_ns) / 1e9
    begin = np.searchsorted(ours.t + shift, theirs.t[0] - 1e-6)
    part = slice(begin, begin + len(theirs.t))
    np.testing.assert_allclose(ours.t[part] + shift, theirs.t, rtol=0, atol=2e-7)
    assert ours.epc[part] == theirs.epc
    assert ours.antenna[part] == theirs.antenna
    for column in ("age", "rssi", "phase", "frequency"):
        np.testing.assert_allclose(getattr(ours, column)[part], getattr(theirs, column), rtol=0, atol=1e-6)


def test_readers_and_a_single_one_do_not_go_together(hall, refused):
    hall.write_text(MANIFEST + READERS)
    refused(hall, "has rfid and readers")
