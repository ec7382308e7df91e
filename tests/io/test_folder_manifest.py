"""A proposed manifest for a folder of tables: a log that is read with it has the values in our units."""

import tomllib
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorgraph_loc import InputError, manifest, read_log
from factorgraph_loc.io.guesses import guess

START = 1.7e9  # s since 1970
T = np.arange(0.0, 60.0, 0.1)  # s
HEADING = 1.2 * np.sin(0.2 * T)
SPEED = 0.5  # m/s
X, Y = np.cumsum(0.1 * SPEED * np.cos(HEADING)), np.cumsum(0.1 * SPEED * np.sin(HEADING))


def write(path, lines):
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_truth(folder, start=START):
    rows = zip(start + T, X, Y, np.sin(HEADING / 2.0), np.cos(HEADING / 2.0), strict=True)
    write(folder / "mocap.txt", [f"{t:.6f} {x:.4f} {y:.4f} 0 0 0 {s:.6f} {c:.6f}" for t, x, y, s, c in rows])


def log_of(folder):
    """The log in the folder ``day``, read by the manifest that is proposed for it."""
    proposal = manifest(folder / "day")
    (folder / "day.toml").write_text(proposal.text)
    return read_log(folder / "day.toml"), proposal


def test_poses_in_millimetres_and_degrees_with_another_clock(tmp_path):
    rows = zip(1000.0 * T, 1000.0 * X, 1000.0 * Y, np.degrees(HEADING) % 360.0, strict=True)
    lines = [f"{t:.0f};{x:.1f};{y:.1f};{h:.3f}".replace(".", ",") for t, x, y, h in rows]
    write(tmp_path / "day" / "wheels.csv", ["millis;x;y;heading", *lines])
    write_truth(tmp_path / "day")
    log, proposal = log_of(tmp_path)
    assert proposal.content["options"]["odometry"]["clock_offset"] == pytest.approx(START)
    odometry = log.streams["odometry"]
    assert np.sum(np.hypot(odometry.dx, odometry.dy)) == pytest.approx(SPEED * 59.9, rel=1e-3)
    assert np.sum(odometry.dtheta) == pytest.approx(HEADING[-1] - HEADING[0], abs=1e-3)
    assert log.reference.at(np.array([30.0]))[0] == pytest.approx([X[300], Y[300], HEADING[300]], abs=1e-3)


def test_several_tables_of_ranges_are_several_sensors(tmp_path):
    rows = zip(START + T, X, Y, HEADING, strict=True)
    write(tmp_path / "day" / "odometry.csv", ["t,x,y,heading", *(f"{t:.3f},{x},{y},{h}" for t, x, y, h in rows)])
    for name, distance in (("left", 2.0), ("right", 3.0)):
        lines = [f"{START + t:.3f},7,{distance}" for t in T]
        write(tmp_path / "day" / f"uwb_{name}.csv", ["t,anchor,range", *lines])
    log, proposal = log_of(tmp_path)
    assert set(proposal.content["options"]["bearing_range"]) == {"left", "right"}
    assert set(log.streams["bearing_range.left"].range) == {2.0}
    assert set(log.streams["bearing_range.right"].range) == {3.0}
    assert "`fgloc rigs new --landmarks left=0.1,right=0.1`" in proposal.text


def test_counters_of_wheels_that_wrap_get_their_size_from_the_reference(tmp_path):
    turned = 0.4 * np.unwrap(HEADING)
    left, right = ((SPEED * T + side * turned / 2.0) / 0.0005 for side in (-1, 1))
    rows = zip(START + T, left, right, strict=True)
    lines = [f"{t:.3f},{int(a) % 65536},{int(b) % 65536}" for t, a, b in rows]
    write(tmp_path / "day" / "encoders.csv", ["stamp,ticksLeft,ticksRight", *lines])
    write_truth(tmp_path / "day")
    log, proposal = log_of(tmp_path)
    odometry = proposal.content["options"]["odometry"]
    assert odometry["units"]["left"] == pytest.approx(0.0005, rel=0.02)
    assert odometry["track"] == pytest.approx(0.4, rel=0.05)
    assert np.sum(log.streams["odometry"].dx) == pytest.approx(SPEED * 59.9, rel=0.02)


def test_noise_of_encoders_and_another_clock_leave_the_sizes_right(tmp_path):
    later = T >= 5.0  # the reference begins first, by a clock of its own
    noise = np.random.default_rng(3).normal(0.0, 0.002, (2, len(T))).cumsum(axis=1)  # 2 mm a row
    turned = 0.4 * np.unwrap(HEADING)
    left, right = ((SPEED * T + side * turned / 2.0 + noise[i]) / 0.0005 for i, side in enumerate((-1, 1)))
    lines = [f"{1e3 * t:.0f},{a:.0f},{b:.0f}" for t, a, b in zip(T[later], left[later], right[later], strict=True)]
    write(tmp_path / "day" / "encoders.csv", ["millis,left,right", *lines])
    write_truth(tmp_path / "day", START + 100.0)
    _, proposal = log_of(tmp_path)
    odometry = proposal.content["options"]["odometry"]
    assert odometry["units"]["left"] == pytest.approx(0.0005, rel=0.03)
    assert odometry["track"] == pytest.approx(0.4, rel=0.05)
    offsets = [table["clock_offset"] for table in proposal.content["options"].values() if "clock_offset" in table]
    assert np.abs(offsets) == pytest.approx([START + 100.0], abs=0.2)


def test_a_straight_drive_shows_no_offset_of_clocks(tmp_path):
    write(tmp_path / "day" / "odometry.csv", ["t,x,y,heading", *(f"{t:.2f},{SPEED * t},0,0" for t in T)])
    write(tmp_path / "day" / "truth.csv", ["t,x,y,heading", *(f"{START + t:.2f},{SPEED * t},0,0" for t in T[50:])])
    _, proposal = log_of(tmp_path)
    offsets = [table["clock_offset"] for table in proposal.content["options"].values() if "clock_offset" in table]
    assert np.abs(offsets) == pytest.approx([START + 5.0])


def test_four_wheels_are_proposed_together(tmp_path):
    rows = [f"{t:.3f},{','.join(str(int(SPEED * t / 0.001)) for _ in range(4))}" for t in T]
    write(tmp_path / "day" / "wheels.csv", ["time_s,ticks_fl,ticks_fr,ticks_rl,ticks_rr", *rows])
    write_truth(tmp_path / "day")
    _, proposal = log_of(tmp_path)
    columns = {"left": "ticks_fl", "right": "ticks_fr", "rear_left": "ticks_rl", "rear_right": "ticks_rr"}
    assert proposal.content["options"]["odometry"]["columns"] == {"t": "time_s"} | columns


def test_reads_rounds_and_a_map_beside_the_folder(tmp_path):
    day = tmp_path / "day"
    write(day / "odom.csv", ["t,v,w", *(f"{START + t:.3f},0.5,0.0" for t in T)])
    write(
        day / "tagreads.csv",
        [
            "when,ant,serial,power",
            *(f"2023-11-14T22:13:{20 + i:02d}.5Z,{'AB'[i % 2]},E28011606000{i % 4:04X},-61.5" for i in range(20)),
        ],
    )
    write(
        day / "sweeps.csv",
        ["finished,ant,len_ms", *(f"2023-11-14T22:13:{20 + i:02d}.9Z,{'AB'[i % 2]},800" for i in range(20))],
    )
    write(
        tmp_path / "survey.csv",
        ["Serial;X [cm];Y [cm];Faces [deg]", *(f"e28011606000{i:04x};{100 * i};250;90" for i in range(4))],
    )
    proposal = manifest(day)
    lines = list(proposal.remarks)
    begin = next(i for i, line in enumerate(lines) if line.startswith("name = "))
    world = [line for line in lines[begin:] if not line.startswith("no ")]
    write(tmp_path / "hall.world.toml", world)
    log, proposal = log_of(tmp_path)
    assert proposal.content["world"] == "hall.world.toml"
    assert (log.world.tags["E280116060000002"].x, log.world.tags["E280116060000002"].facing) == pytest.approx(
        (2.0, np.pi / 2)
    )
    reads = log.streams["rfid"]
    assert {epc for epc in reads.epc if epc} == set(log.world.tags)
    assert set(reads.antenna) == {"A", "B"}
    assert np.nanmax(reads.rssi) == -61.5


def test_ranges_and_anchors_of_the_folder(tmp_path):
    day = tmp_path / "day"
    write(day / "odom.tsv", ["time\tvx\tomega", *(f"{START + t:.3f}\t0.5\t{20.0 * np.cos(t):.2f}" for t in T)])
    write(
        day / "uwb.csv",
        ["timestamp_us,anchor,range_mm", *(f"{(START + t) * 1e6:.0f},a{i % 3},4200" for i, t in enumerate(T))],
    )
    write(day / "anchors.csv", ["anchor,x_m,y_m", "a0,0,0", "a1,5,0", "a2,5,5"])
    log, _ = log_of(tmp_path)
    assert log.streams["bearing_range"].range[0] == pytest.approx(4.2)
    assert log.streams["odometry"].w[0] == pytest.approx(np.radians(20.0))
    assert list(log.world.landmarks) == ["a0", "a1", "a2"]


@given(st.sampled_from((("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9))), st.floats(1.0e9, 2.5e9), st.booleans())
def test_the_unit_of_times_since_1970_is_found(tmp_path_factory, unit, start, named):
    name, factor = unit
    path = tmp_path_factory.mktemp("table") / "odometry.csv"
    write(
        path,
        [f"{f'time_{name}' if named else 'stamp'},v,w", *(f"{round((start + t) * factor)},0.5,0.1" for t in range(20))],
    )
    found = guess(path)
    assert found.units["t"] == name
    assert found.times()[0] == pytest.approx(start, abs=1.0)


def test_a_folder_without_a_table_is_refused(tmp_path):
    write(tmp_path / "day" / "notes.txt", ["drove twice round the hall", "battery low"])
    with pytest.raises(InputError, match=r"day: has no table with times, expected files such as odometry.csv"):
        manifest(tmp_path / "day")


CELLS = st.sampled_from(["t", "x", "y", "left", "epc", "1", "2.5", "", "-7e9", "nan", "a b"])


@given(st.lists(st.lists(CELLS, min_size=1, max_size=9)))
def test_any_table_is_guessed_or_refused(tmp_path_factory, rows):
    day = tmp_path_factory.mktemp("day")
    write(day / "odometry.csv", ["t,x,y,left,right,antenna,epc,when,heading", *(",".join(row) for row in rows)])
    with suppress(InputError):
        assert manifest(day).content["reader"] == "mapped"


def test_a_file_name_of_two_lines_adds_no_key(tmp_path):
    write(tmp_path / "day" / "odometry.csv", ["t,v,w", *(f"{START + t:.3f},0.5,0.0" for t in T)])
    write(tmp_path / "day" / "notes\ntitle = 'x'", ["drove twice round the hall"])
    assert tomllib.loads(manifest(tmp_path / "day").text)["title"] == "The folder day"


def test_a_table_of_positions_is_a_sensor_beside_a_reference(tmp_path):
    write(tmp_path / "day" / "odom.csv", ["t,v,w", *(f"{START + t:.3f},0.5,0.0" for t in T)])
    rows = zip(START + T, 1000.0 * X, 1000.0 * Y, strict=True)
    write(tmp_path / "day" / "uwb.csv", ["time_s,x_mm,y_mm", *(f"{t:.3f},{x:.0f},{y:.0f}" for t, x, y in rows)])
    write_truth(tmp_path / "day")
    log, proposal = log_of(tmp_path)
    assert proposal.content["options"]["position"]["file"] == "uwb.csv"
    assert log.streams["position"].x[300] == pytest.approx(X[300], abs=1e-3)


def test_a_map_of_anchors_has_their_heights(tmp_path):
    write(tmp_path / "day" / "odom.csv", ["t,v,w", *(f"{START + t:.3f},0.5,0.0" for t in T)])
    write(tmp_path / "day" / "uwb.csv", ["t,anchor,dist_mm", *(f"{START + t:.3f},a,2000" for t in T)])
    write(tmp_path / "day" / "anchors.csv", ["name,x_m,y_m,z_m", "a,1.0,2.0,2.5"])
    log, _ = log_of(tmp_path)
    assert log.world.landmarks["a"].z == 2.5
