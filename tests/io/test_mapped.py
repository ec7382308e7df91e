"""A folder of other programs' tables, read by a manifest."""

import numpy as np
import pytest
from mapped_hall import MANIFEST, ODOMETRY, READS, WHEELS

from factorgraph_loc.files.cells import iso_nanoseconds
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream


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


def test_poses_are_odometry_by_the_motion_between_them(hall, with_options, one):
    rows = "# poses\n1 0 0 0 0 0 1\n2 0 1 0 0 {h} {h}\n3 0 2 0 0 {h} {h}\n"
    (hall.parent / "run" / "odom.txt").write_text(rows.format(h=np.sqrt(0.5)))
    log = one(
        with_options(
            '[options.odometry]\nfile = "odom.txt"\nseparator = " "\nheader = false\nunits = { t = "s" }\n'
            'columns = { t="1", x="2", y="3", qx="4", qy="5", qz="6", qw="7" }\n'
        )
    )
    odometry = log.streams["odometry"]
    assert isinstance(odometry, IncrementStream)
    np.testing.assert_allclose(odometry.dx, (0.0, 0.0, 1.0), atol=1e-12)
    np.testing.assert_allclose(odometry.dy, (0.0, 1.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(odometry.dtheta, (0.0, np.pi / 2, 0.0), atol=1e-9)


def test_tables_of_several_sensors(hall, with_options, one, refused):
    folder = hall.parent / "run"
    for name, distance in (("left", 1.5), ("right", 2.5)):
        (folder / f"{name}.csv").write_text(f"t,id,m\n1.2,A,{distance}\n")
    options = "".join(
        f'[options.bearing_range.{name}]\nfile = "{name}.csv"\nunits = {{ t = "s" }}\n'
        'columns = { t = "t", landmark = "id", range = "m" }\n'
        for name in ("left", "right")
    )
    log = one(with_options(WHEELS + options))
    assert log.streams["bearing_range.left"].range.tolist() == [1.5]
    assert log.streams["bearing_range.right"].range.tolist() == [2.5]
    assert log.rig.sensors == ("odometry", "bearing_range.left", "bearing_range.right")
    refused(with_options(WHEELS + options.replace("file =", "fil =")), "bearing_range.left.fil", "did you mean file?")


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
    refused(with_options(one_axis + 'axes = "optical"\n'), "axes or mounting is given, but columns lacks wx, wy, wz")


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
    assert [w.fields["missing"] for w in log.warnings if w.kind == "missing_images"] == [1]


@pytest.mark.parametrize("form", ["tum", "kitti", "euroc"])
def test_poses_of_a_data_set(hall, with_options, one, refused, form):
    folder = hall.parent / "run"
    (folder / "poses.txt").write_text(
        {
            "euroc": "#timestamp,x,y,z,qw,qx,qy,qz,vx\n1000000000,0,0,0,1,0,0,0,5\n2000000000,3,1,0,0.7071068,0,0,0.7071068,5\n",
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
    as_odometry = f'[options.odometry]\nfile = "poses.txt"\nformat = "{form}"\n{times}'
    moved = one(with_options(as_odometry)).streams["odometry"]
    np.testing.assert_allclose(moved.t, (0.0, 1.0))
    np.testing.assert_allclose(np.stack((moved.dx, moved.dy, moved.dtheta))[:, 1], (3, 1, np.pi / 2), atol=1e-6)
    refused(with_options(f"{as_odometry}track = 0.5\n"), f"format {form} has no wheels: remove track")
    if form == "kitti":
        refused(with_options(as_odometry.replace(times, "")), "format is kitti, but times is missing")
    else:
        refused(with_options(f'{as_odometry}times = "times.txt"\n'), f"times is given, but format is {form}")


def test_stamps_keep_their_nanoseconds():
    assert iso_nanoseconds("2026-04-09T14:24:20.255000001-05:00") == 1775762660255000001
    assert iso_nanoseconds("2026-04-09 19:24:20.255") == 1775762660255000000
    assert iso_nanoseconds("2026-04-09T19:24:20") == 1775762660000000000


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        ('t = "ms", v', "v", ("wheels.csv", "units.t is None", "iso")),
        ('w = "deg/s" }', 'w = "degrees" }', ("wheels.csv", "unit of w is 'degrees'", "rad/s, deg/s")),
        ('file = "truth.csv"', 'file = "../../truth.csv"', ("leaves its folder",)),
        (
            '"impinj_itemtest"',
            '"impinj_itemtest"\nchannels = [866.3]',
            ("channels is given, but columns has no channel",),
        ),
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
        ("wheels.csv", "", ("wheels.csv: contains no rows",)),
        ("wheels.csv", ODOMETRY + "yesterday;1;0\n", ("wheels.csv:5", "time_ms is 'yesterday'", "a number of ms")),
        (
            "reads.csv",
            READS + "4/9/2026 2:15 PM,e2001,,1,-60,866.3,r,1,0,\n",
            ("reads.csv:6", "Timestamp", "2026-01-31"),
        ),
        ("reads.csv", READS.replace(",e2002,", ",,"), ("reads.csv:4", "EPC is ''", "the EPC of a tag")),
    ],
)
def test_a_wrong_file(hall, refused, file, content, fragments):
    (hall.parent / "run" / file).write_text(content)
    refused(hall, *fragments)


NAMES = """
[options.bearing_range]
file = "seen.csv"
columns = { t = "t", landmark = "code", range = "range" }
units = { t = "s" }

[options.bearing_range.names]
file = "codes.csv"
columns = { file_name = "code", name = "post" }
where = { moves = "no" }

[options.world]
name = "yard"

[options.world.landmarks]
file = "posts.csv"
columns = { landmark = "post", x = "x", y = "y", sigma_x = "sx", sigma_y = "sy" }
units = { x = "cm", y = "cm", sigma_x = "mm", sigma_y = "mm" }
"""


@pytest.fixture
def yard(hall, with_options):
    """A manifest whose robot measures codes of posts; the tables of posts and codes lie in the folder of the log."""
    folder = hall.parent / "run"
    (folder / "seen.csv").write_text("t,code,range\n1,63,2.5\n1,5,1.0\n2,99,3.0\n2,81,1.5\n")
    (folder / "codes.csv").write_text("code,post,moves\n63,A,no\n81,B,no\n5,cart,yes\n")
    (folder / "posts.csv").write_text("post,x,y,sx,sy\nA,100,200,1,2\nB,-50,0,4,3\n")
    with_options(WHEELS + NAMES)
    return folder


@pytest.mark.usefixtures("yard")
def test_names_of_the_map_and_the_map_are_tables_of_the_folder(hall, one):
    log = one(hall)
    seen = log.streams["bearing_range"]
    assert list(seen.landmark) == ["A", "B"]
    np.testing.assert_array_equal(seen.range, (2.5, 1.5))
    assert any(
        "seen.csv: 2 rows are skipped: their landmark is not listed in codes.csv" in str(told) for told in log.warnings
    )
    assert (log.world.name, list(log.world.landmarks)) == ("yard", ["A", "B"])
    for name, expected in {"A": (1.0, 2.0, 0.002), "B": (-0.5, 0.0, 0.004)}.items():
        landmark = log.world.landmarks[name]
        np.testing.assert_allclose((landmark.x, landmark.y, landmark.sigma), expected)


@pytest.mark.parametrize(
    ("file", "text", "fragments"),
    [
        ("codes.csv", "code,post,moves\n63,A,no\n63,B,no\n", ("codes.csv:3: code is '63'", "each name once")),
        (
            "codes.csv",
            "code,post,moves\n7,A,no\n",
            ("seen.csv: no row has a landmark", "listed in codes.csv, such as 7"),
        ),
        ("posts.csv", "post,x,y,sx,sy\nA,1,2,1,1\nA,1,2,1,1\n", ("posts.csv:3: landmark is 'A'", "than in row 2")),
    ],
)
def test_wrong_tables_of_names_and_landmarks(hall, yard, refused, file, text, fragments):
    (yard / file).write_text(text)
    refused(hall, *fragments)


def test_bearings_that_are_counted_to_360_degrees(hall, with_options, one):
    (hall.parent / "run" / "seen.csv").write_text("t,post,bearing\n1,A,350\n2,A,10\n")
    columns = (
        '[options.bearing_range]\nfile = "seen.csv"\ncolumns = { t = "t", landmark = "post", bearing = "bearing" }\n'
    )
    log = one(with_options(WHEELS + columns + 'units = { t = "s", bearing = "deg" }\n'))
    np.testing.assert_allclose(log.streams["bearing_range"].bearing, np.radians((-10.0, 10.0)))
