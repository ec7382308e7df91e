"""RFID reads in the native format: rounds from gaps and from inventories, and that what is written comes back."""

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from factorgraph_loc import Log, RfidStream, Rig, Tag, VelocityStream, World, load, write_native
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings

READS = "t_ns,antenna,epc,rssi,phase,frequency\n"
INVENTORIES = "t_ns,antenna,duration\n"


def seconds(*values):
    return np.array(values) * 1e-9


@pytest.fixture
def hall(native):
    """The hall's log, from 1 s to 2 s, with reads: t = 0 at 1 s."""
    (native / "bearing_range.csv").unlink()
    (native / "rfid.csv").write_text(
        READS
        + "1100000000,left,E1,-60,0.5,915e6\n1130000000,left,E2,,,\n"
        + "1130000000,right,E1,-61.5,,\n1200000000,right,E2,,6.25,\n"
    )
    return native


def test_rounds_from_gaps(hall, one):
    log = one(hall)
    reads = log.streams["rfid"]
    assert reads.antenna == ["left", "left", "right", "right"]
    assert reads.round.tolist() == [0, 0, 1, 2]
    # a round is over with the other antenna's read, or after the gap of 50 ms
    np.testing.assert_allclose(reads.t, (0.13, 0.13, 0.18, 0.25))
    np.testing.assert_allclose(reads.age, (0.03, 0.0, 0.05, 0.05))
    np.testing.assert_array_equal(reads.rssi, (-60.0, np.nan, -61.5, np.nan))
    np.testing.assert_array_equal(reads.phase, (0.5, np.nan, np.nan, 6.25))
    left, *right = log.measurements(("rfid",))
    assert (left.antennas, left.tags) == (("left",), ("E1", "E2"))
    assert [(m.antennas, m.tags) for m in right] == [(("right",), ("E1",)), (("right",), ("E2",))]
    assert log.warnings == ()


@pytest.mark.parametrize(
    ("header", "row", "rssi"), [("t_ns,antenna,epc", "", np.nan), ("epc,antenna,t_ns,rssi", ",-60", -60.0)]
)
def test_readers_that_tell_less(hall, one, header, row, rssi):
    """Without strength or phase, and with the columns in another order."""
    first = ("1100000000", "left", "E1") if header.startswith("t_ns") else ("E1", "left", "1100000000")
    (hall / "rfid.csv").write_text(f"{header}\n{','.join(first)}{row}\n")
    reads = one(hall).streams["rfid"]
    assert (reads.antenna, reads.epc) == (["left"], ["E1"])
    np.testing.assert_array_equal(reads.rssi, (rssi,))
    assert np.isnan(reads.phase).all()
    assert np.isnan(reads.frequency).all()


def test_the_gap_is_the_rigs(hall, one):
    rig = "[rig.rfid]\nround_gap = 0.1\nantennas.left = {}\nantennas.right = {}\n"
    (hall / "run.toml").write_text(rig)
    assert one(hall).streams["rfid"].round.tolist() == [0, 0, 1, 1]


def test_rounds_from_inventories(hall, one):
    (hall / "inventories.csv").write_text(
        INVENTORIES
        + "1150000000,left,0.05\n1150000000,right,0.02\n1150000000,back,0.05\n1180000000,right,0.01\n1240000000,left,0.05\n"
    )
    log = one(hall)
    reads = log.streams["rfid"]
    assert list(zip(reads.antenna, reads.epc, strict=True)) == [
        ("left", "E1"),
        ("left", "E2"),
        ("right", "E1"),
        ("back", ""),
        ("right", ""),
        ("left", ""),
    ]
    np.testing.assert_allclose(reads.age, (0.05, 0.02, 0.02, 0.0, 0.0, 0.0))
    first, second, third = log.measurements(("rfid",))
    assert (first.antennas, len(first.tags)) == (("left", "right", "back"), 3)
    assert (second.antennas, second.tags, third.t) == (("right",), (), 0.24)
    (warning,) = log.warnings
    assert "rfid.csv: 1 of 4 reads lie outside of every inventory and are skipped" in str(warning)


def test_inventories_of_antennas_that_read_nothing(hall, one):
    (hall / "rfid.csv").unlink()
    (hall / "inventories.csv").write_text(INVENTORIES + "1500000000,left,0.5\n2000000000,left,0.5\n")
    scans = list(one(hall).measurements(("rfid",)))
    assert [(scan.t, scan.antennas, scan.tags) for scan in scans] == [(0.5, ("left",), ()), (1.0, ("left",), ())]


BAD = {
    "no tag": ("rfid.csv", READS + "1,left,,,,\n", "rfid.csv:2: epc is ''", "EPC of a tag"),
    "no duration": ("inventories.csv", INVENTORIES + "1,left,\n", "inventories.csv:2: duration is ''", "seconds"),
}


@pytest.mark.parametrize(("name", "text", "fragments"), [(n, t, f) for n, t, *f in BAD.values()], ids=list(BAD))
def test_what_is_refused(hall, refused, name, text, fragments):
    (hall / name).write_text(text)
    refused(hall, *fragments)


BAD_PLACES = {
    "beyond": ("3", "inventory is 3.0", "1 to 2"),
    "none": ("", "inventory is ''", "a whole number"),
    "half": ("1.5", "inventory is 1.5", "a whole number"),
    "of another antenna": ("2", "inventory is 2.0", "of the same antenna"),
}


@pytest.mark.parametrize(("place", "fragments"), [(p, f) for p, *f in BAD_PLACES.values()], ids=list(BAD_PLACES))
def test_reads_that_name_a_wrong_inventory(hall, refused, place, fragments):
    (hall / "rfid.csv").write_text(READS.strip() + f",inventory\n1000000000,left,E1,,,,{place}\n")
    (hall / "inventories.csv").write_text(INVENTORIES + "1200000000,left,0.5\n1200000000,right,0.5\n")
    refused(hall, "rfid.csv:2:", *fragments)


def test_tags_of_the_map_beside_it(hall, one):
    (hall / "hall.tags.csv").write_text("epc,x,y,z,facing\nE1,1,2,0.5,\n")
    (hall / "run.toml").write_text('[world]\ntags = "hall.tags.csv"\n[rig.rfid]\npreset = "rackham"\n')
    log = one(hall)
    assert (log.world.tags, log.warnings) == ({"E1": Tag(x=1, y=2, z=0.5)}, ())


names = st.text(st.characters(exclude_categories=("Cs", "Cc")), min_size=1, max_size=4)
values = st.one_of(st.just(np.nan), st.floats(-100.0, 0.0))
phases = st.one_of(st.just(np.nan), st.floats(0.0, 6.25))
frequencies = st.one_of(st.just(np.nan), st.floats(8e8, 1e9))


@st.composite
def streams(draw):
    """Rounds at any stamps, in any order, ages to the nanosecond; rounds of one antenna may overlap."""
    rows = []
    ends = draw(st.lists(st.one_of(st.just(10**9), st.integers(10**9, 10**12)), min_size=1, max_size=6))
    for number, end in enumerate(ends):
        antenna = draw(st.sampled_from(("left", "right")))
        reads = draw(st.lists(st.tuples(names, st.integers(0, 10**9), values, phases, frequencies), max_size=3))
        for epc, age, rssi, phase, frequency in reads or [("", 0, np.nan, np.nan, np.nan)]:
            rows.append((end / 1e9, number, antenna, epc, age / 1e9, rssi, phase, frequency))
    t, number, antenna, epc, *rest = zip(*rows, strict=True)
    return RfidStream(np.array(t), np.array(number), list(antenna), list(epc), *map(np.array, rest))


@given(stream=streams(), format=st.sampled_from(["csv", "parquet"]), t0_ns=st.integers(-(10**18), 2 * 10**18))
@settings(max_examples=60, suppress_health_check=list(HealthCheck))
def test_what_is_written_comes_back(tmp_path_factory, stream, format, t0_ns):
    odometry = VelocityStream(np.array((0.0, 1.0)), np.ones(2), np.zeros(2))
    rig = Rig(sensors=("odometry", "rfid"), rfid=RfidSettings(antennas={"left": AntennaSettings(yaw=0.5)}))
    world = World(tags={epc: Tag(x=0.1, y=1 / 3, facing=-1.5) for epc in stream.epc if epc})
    log = Log("rounds", rig, world, {"odometry": odometry, "rfid": stream}, t0_ns=t0_ns)
    folder = tmp_path_factory.mktemp("logs") / "out"
    write_native(log, folder, format=format)
    (back,) = load(str(folder))
    assert (back.rig, back.world, back.t0_ns) == (rig, world, t0_ns)
    for field in dataclasses.fields(stream):
        np.testing.assert_array_equal(getattr(back.streams["rfid"], field.name), getattr(stream, field.name))
