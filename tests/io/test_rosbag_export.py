"""A log becomes a bag and comes back: all of its measurements, whatever they are."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import parse_model
from factorgraph_loc.io.bags import rosbag
from factorgraph_loc.io.bags.export import write_bag
from factorgraph_loc.io.bags.file import open_bag
from factorgraph_loc.io.bags.manifest import propose
from factorgraph_loc.io.readers import load
from factorgraph_loc.model.log import Log, StartPose
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.stream import ImageStream, SightingStream
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream, YawRateStream
from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.sensors.rfid.stream import RfidStream

T0 = 1_700_000_000_123_456_789
SUFFIXES = [".bag", ".mcap", ".db3"]
NAMES = ("A", "Bär", "c 3")
NUMBERS = st.floats(-100.0, 100.0)
MOVES = st.floats(-3.0, 3.0)


def back(path):
    """What the manifest that is proposed for a bag makes of it."""
    with open_bag(path) as bag:
        options = propose(bag).options
    return rosbag.read(path, parse_model(rosbag.Options, options, "proposal"))


def stamps(draw, count, least=1_000):
    """Stamps in seconds, exact to the nanosecond, at least so many of them apart."""
    steps = draw(st.lists(st.integers(least, least + 10**9), min_size=count, max_size=count))
    return np.cumsum(steps) / 1e9


@st.composite
def logs(draw):
    count = draw(st.integers(2, 12))
    column = lambda kind: np.array(draw(st.lists(kind, min_size=count, max_size=count)))  # noqa: E731
    t = stamps(draw, count)
    if draw(st.booleans()):
        odometry = VelocityStream(t, column(NUMBERS), column(NUMBERS))
    else:
        moves = [column(MOVES) for _ in range(3)]
        for move in moves:
            move[0] = 0.0
        # slow enough to be no jump, as to the origin, where odometry that begins anew would be
        odometry = IncrementStream(stamps(draw, count, 2 * 10**9), *moves)
    streams = {"odometry": odometry, "imu": YawRateStream(stamps(draw, count), column(NUMBERS))}
    names = draw(st.lists(st.sampled_from(NAMES), min_size=count, max_size=count))
    ranges = column(st.floats(0.1, 100.0) | st.just(np.nan))
    bearings = np.where(np.isnan(ranges), 0.5, column(st.floats(-3.0, 3.0) | st.just(np.nan)))
    streams["bearing_range"] = BearingRangeStream(stamps(draw, count), names, ranges, bearings)
    streams["sightings"] = SightingStream(stamps(draw, count), names, column(NUMBERS), column(NUMBERS))
    streams["rfid"] = draw_rounds(draw)
    return Log("drive", Rig(), World(), streams, t0_ns=T0)


def draw_rounds(draw):
    """Rounds of one to three rows, or without a read; of two antennas at the same stamp now and then."""
    rows = []
    ends = np.round(np.cumsum(draw(st.lists(st.floats(0.001, 1.0), min_size=1, max_size=6))), 9)
    for number, t in enumerate(ends.tolist()):
        for antenna in draw(st.sampled_from((("1",), ("2",), ("1", "2")))):
            reads = draw(st.lists(st.tuples(st.sampled_from(("E1", "E2")), st.integers(0, 10**8)), max_size=3))
            nothing = (t, 2 * number + (antenna == "2"), antenna, "", 0.0, np.nan, np.nan, np.nan)
            rows += [
                (t, 2 * number + (antenna == "2"), antenna, epc, age / 1e9, -60.5, np.nan, 865.7e6)
                for epc, age in reads
            ] or [nothing]
    columns = list(zip(*rows, strict=True))
    arrays = [np.array(c, dtype=int if i == 1 else None) for i, c in enumerate(columns)]
    return RfidStream(arrays[0], arrays[1], list(columns[2]), list(columns[3]), *arrays[4:])


def measurements(log):
    """All columns of all streams, stamps as absolute nanoseconds, rounds as they follow each other."""
    out = {}
    for name, stream in log.streams.items():
        columns = {field.name: getattr(stream, field.name) for field in fields(stream)}
        columns["t"] = np.rint(stream.t * 1e9).astype(np.int64) + log.t0_ns
        if "round" in columns:
            columns["round"] = np.cumsum(np.abs(np.diff(columns["round"], prepend=columns["round"][0])) > 0)
        out[name] = columns
    return out


@settings(max_examples=10, deadline=None)
@given(log=logs(), suffix=st.sampled_from(SUFFIXES))
def test_all_measurements_come_back(tmp_path_factory, log, suffix):
    path = tmp_path_factory.mktemp("bags") / f"drive{suffix}"
    write_bag(log, path)
    before, after = measurements(log), measurements(back(path))
    assert set(before) == set(after)
    for name, columns in before.items():
        for key, expected in columns.items():
            found = after[name][key]
            if isinstance(expected, np.ndarray) and expected.dtype.kind == "f":
                # increments are differences of the way that they add up to; ages have the resolution of stamps
                np.testing.assert_allclose(found, expected, rtol=1e-12, atol=2e-9, err_msg=f"{name} {key}")
            else:
                assert list(found) == list(expected), (name, key)


@pytest.fixture
def log(tmp_path):
    """Velocities, two images, a start, a reference, a rig and a map."""
    files = []
    for i, content in enumerate((b"\xff\xd8\xff one", b"\x89PNG two")):
        files.append(tmp_path / f"{i}.{'jpg' if i == 0 else 'png'}")
        files[-1].write_bytes(content)
    t = np.array((0.0, 0.5))
    return Log(
        "drive",
        Rig(name="cart"),
        World(name="hall", tags={"E1": Tag(x=1.0, y=2.0)}),
        {"odometry": VelocityStream(t, t, t), "camera": ImageStream(t + 0.1, files)},
        reference=Trajectory(t, np.array(((1.0, 2.0, 3.0), (1.5, 2.0, -3.1)))),
        start=StartPose(0.25, np.array((1.0, 2.0, 3.0)), np.array((0.1, 0.2, 0.3))),
        t0_ns=T0,
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_images_start_reference_rig_and_map_come_back(log, tmp_path, suffix, monkeypatch):
    monkeypatch.setenv("FGLOC_CACHE", str(tmp_path / "cache"))
    written = write_bag(log, tmp_path / f"drive{suffix}")
    assert [path.name for path in written] == [f"drive{suffix}", "drive.rig.toml", "drive.world.toml"]
    found = back(tmp_path / f"drive{suffix}")
    assert [file.read_bytes() for file in found.streams["camera"].file] == [b"\xff\xd8\xff one", b"\x89PNG two"]
    np.testing.assert_allclose(found.streams["camera"].t, (0.1, 0.6), atol=1e-9)
    np.testing.assert_allclose(found.reference.poses, log.reference.poses, atol=1e-12)
    np.testing.assert_allclose(found.start.pose, log.start.pose, atol=1e-12)
    np.testing.assert_allclose(found.start.sigmas, log.start.sigmas, atol=1e-12)
    assert found.start.t == pytest.approx(0.25, abs=1e-9)


def test_a_native_log_by_its_bag(native, tmp_path):
    """Landmarks with gaps, from files to files."""
    (log,) = load(str(native))
    write_bag(log, tmp_path / "hall.mcap")
    found = back(tmp_path / "hall.mcap").streams["bearing_range"]
    expected = log.streams["bearing_range"]
    assert list(found.landmark) == list(expected.landmark)
    np.testing.assert_array_equal(found.range, expected.range)
    np.testing.assert_array_equal(found.bearing, expected.bearing)


def test_what_a_bag_cannot_hold(log, tmp_path):
    t = np.zeros(1)
    for streams, words in (
        ({"odometry": VelocityStream(t - 2e9, t, t)}, "expected one from 1970 to 2038"),
        ({"camera": ImageStream(t, [tmp_path / "gone.png"])}, "gone.png: cannot be read"),
    ):
        with pytest.raises(InputError, match=words):
            write_bag(Log("drive", log.rig, log.world, streams, t0_ns=T0), tmp_path / "out" / "drive.mcap")
        assert list((tmp_path / "out").iterdir()) == []


def test_nothing_is_written_over(log, tmp_path):
    (tmp_path / "drive.rig.toml").write_text("mine")
    with pytest.raises(InputError, match=r"drive\.rig\.toml: exists"):
        write_bag(log, tmp_path / "drive.mcap")
    assert (tmp_path / "drive.rig.toml").read_text() == "mine"


def test_a_reference_without_headings(log, tmp_path):
    reference = replace(log.reference, has_heading=False)
    write_bag(replace(log, reference=reference, streams={"odometry": log.streams["odometry"]}), tmp_path / "drive.mcap")
    found = back(tmp_path / "drive.mcap").reference
    assert not found.has_heading
    np.testing.assert_array_equal(found.poses[:, :2], reference.poses[:, :2])
