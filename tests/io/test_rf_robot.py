"""Folders of the robot with three antennas: what is read, left out and refused."""

import math

import numpy as np
import pytest

from factorgraph_loc.io.readers import load

T0 = 1_673_511_856_000_000  # us
TAGS = "epc,label,x_m,y_m,z_m,facing_deg\nE-1,A1,1.0,-2.0,1.5,90\nE-2,A2,3.0,-1.0,0.5,-90\n"


def a_read(us, epc="E-1", phase="90", number=1, mhz="920.625", rssi="-60.5"):
    return f"{number} {epc} 1 {mhz} {phase} {rssi} {T0 + us + 5_000_000} {T0 + us}\n"


@pytest.fixture
def aisle(tmp_path):
    """One second of poses; a round of each antenna, one of the third before the poses and one across their end."""
    run = tmp_path / "aisle" / "run4"
    run.mkdir(parents=True)
    (tmp_path / "aisle" / "tags.csv").write_text(TAGS)
    poses = [f"{0.001 * k:.6f} 0.0 0.1 {T0 / 1e6 + 0.005 * k:.6f}" for k in range(201)]
    (run / "reference_pose.txt").write_text("\n".join(poses) + "\n")
    (run / "first.txt").write_text(
        a_read(100_000) + a_read(130_000, "E-2", "180") + a_read(990_000) + a_read(1_010_000)
    )
    (run / "second.txt").write_text(a_read(140_000) + a_read(190_000) + a_read(240_001))
    (run / "third.txt").write_text(a_read(-20_000) + a_read(400_000))
    return tmp_path / "aisle"


@pytest.fixture
def read(one):
    return lambda folder, **options: one(folder, reader="rf_robot", options={"run": 4, **options})


@pytest.fixture
def refuse(refused):
    return lambda folder, *fragments, **options: refused(
        folder, *fragments, reader="rf_robot", options={"run": 4, **options}
    )


def test_what_is_read(aisle, read):
    log = read(aisle)
    assert (log.name, log.t0_ns) == ("aisle-run4", T0 * 1000)
    reads = log.streams["rfid"]
    assert reads.antenna == ["first", "first", "second", "second", "second", "third"]
    assert reads.epc == ["E-1", "E-2", "E-1", "E-1", "E-1", "E-1"]
    assert reads.round.tolist() == [0, 0, 1, 1, 2, 3]
    # a round is over with another antenna's read, or after 50 ms
    np.testing.assert_allclose(reads.t, (0.14, 0.14, 0.24, 0.24, 0.290001, 0.45))
    np.testing.assert_allclose(reads.age, (0.04, 0.01, 0.1, 0.05, 0.05, 0.05))
    np.testing.assert_allclose(reads.phase[:2], (math.pi / 2, math.pi))
    assert (reads.rssi[0], reads.frequency[0]) == (-60.5, 920.625e6)
    left_out, _ = log.warnings
    assert "3 of 9 reads are outside of the reference" in left_out
    tag = log.world.tags["E-2"]
    assert (tag.x, tag.y, tag.z, tag.facing) == (3.0, -1.0, 0.5, -math.pi / 2)
    assert np.diff(log.reference.t).max() <= 0.1
    assert log.streams["odometry"].t[-1] == pytest.approx(1.0)
    assert "simulated" in log.metadata["odometry"]


def test_the_seed_is_an_option_and_changes_the_odometry_only(aisle, read):
    first, second = read(aisle), read(aisle, odometry_seed=1)
    assert np.any(first.streams["odometry"].dx != second.streams["odometry"].dx)
    np.testing.assert_array_equal(first.streams["rfid"].t, second.streams["rfid"].t)
    assert "seed 1" in second.metadata["odometry"]


def test_an_antenna_without_reads(aisle, read):
    (aisle / "run4" / "third.txt").write_text("")
    log = read(aisle)
    assert set(log.streams["rfid"].antenna) == {"first", "second"}
    assert any("third.txt: contains no reads" in warning for warning in log.warnings)


def test_late_reads_are_put_in_order(aisle, read):
    (aisle / "run4" / "first.txt").write_text(a_read(130_000, "E-2") + a_read(100_000))
    log = read(aisle)
    assert log.streams["rfid"].epc[:2] == ["E-1", "E-2"]
    assert any("first.txt: 1 rows are late" in warning for warning in log.warnings)


BAD = {
    "no such run": (None, None, "run is 4", "run5"),
    "run not there": ("run4/second.txt", None, "second.txt: cannot be read"),
    "short row": ("run4/first.txt", "1 E-1 1 920.6\n", "first.txt:1: row is '1 E-1 1 920.6'", "8 values"),
    "phase not a number": ("run4/first.txt", a_read(1, phase="x"), "first.txt:1: phase degrees is 'x'"),
    "phase beyond": ("run4/first.txt", a_read(1) + a_read(2, phase="400"), "first.txt:2: phase degrees is 400.0"),
    "carrier in Hz": ("run4/first.txt", a_read(1, mhz="920625000"), "carrier MHz", "840 to 960"),
    "nan": ("run4/first.txt", a_read(1, rssi="nan"), "RSSI dBm is 'nan'", "finite"),
    "clock in seconds": ("run4/first.txt", "1 E-1 1 920.6 1 -60 1.5 1.5\n", "host clock us is '1.5'", "whole number"),
    "time going back": (
        "run4/first.txt",
        a_read(900_000) + a_read(300_000),
        "first.txt:2: time",
        "at most 0.5 s older",
    ),
    "tags without facing": ("tags.csv", "epc,x_m,y_m,z_m\nE-1,1,1,1\n", "column facing_deg is missing"),
    "tag twice": ("tags.csv", TAGS + "E-1,A3,1,1,1,0\n", "tags.csv:4: epc is 'E-1'", "than in row 2"),
    "tag nowhere": ("tags.csv", TAGS + "E-3,A3,,1,1,0\n", "tags.csv:4: x_m is ''", "a finite number of m"),
    "facing beyond": ("tags.csv", TAGS + "E-3,A3,1,1,1,500\n", "tags.csv:4: facing_deg is 500.0"),
    "no tags": ("tags.csv", TAGS[:33] + "\n", "contains no tags"),
    "reference short": ("run4/reference_pose.txt", "0 0 0 1673511856.0\n", "less than 0.1 s of poses"),
    "a clock that jumps by months": (
        "run4/reference_pose.txt",
        "0 0 0 1673511856\n" + "0 0 0 1683511856.3\n" * 5,
        "reference_pose.txt:1: stamp is '1673511856000000000 ns'",
        "at most 30 days from all others",
    ),
    "reference going back": ("run4/reference_pose.txt", "0 0 0 5.0\n0 0 0 4.0\n", "reference_pose.txt:2: time"),
}


@pytest.mark.parametrize(("name", "text", "fragments"), [(n, t, f) for n, t, *f in BAD.values()], ids=list(BAD))
def test_what_is_refused(aisle, refuse, name, text, fragments):
    if name is None:
        (aisle / "run4").rename(aisle / "run5")
    elif text is None:
        (aisle / name).unlink()
    else:
        (aisle / name).write_text(text)
    refuse(aisle, *fragments)


def test_options_that_are_none(aisle, refuse):
    refuse(aisle, "odometry_seed is -1", odometry_seed=-1)
    refuse(aisle, "run is 'x'", run="x")


@pytest.mark.parametrize(("run", "reads", "rounds"), [(13, 63752, 3383), (16, 69503, 3709)])
def test_recorded_runs(data_root, run, reads, rounds):
    (log,) = load(f"rfid-aisle-run{run}", data_root=data_root)
    stream = log.streams["rfid"]
    assert (len(stream.t), len(list(log.measurements(("rfid",))))) == (reads, rounds)
    assert set(stream.antenna) == set(log.rig.rfid.all_antennas())
    assert set(log.world.tags) <= set(stream.epc)  # each tag is read
    assert stream.t.max() <= log.streams["odometry"].t[-1]
    assert 2.5 < rounds / 3 / (log.span()[1] - log.span()[0]) < 3.5  # about three rounds per second and antenna
