"""Rows that are invalid or out of order: refused with the key to type, or skipped, sorted and counted."""

import json
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mapped_hall import VELOCITIES, WHEELS, write_mapped
from rosbag_drive import COUNT, MS, T0, add_imu

from factorgraph_loc import read_log
from factorgraph_loc.sensors.odometry.jumps import jumps
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, YawRateStream
from factorgraph_loc.sensors.odometry.summary import summarize

SKIP, SORT = 'bad_rows = "skip"\n', 'order = "sort"\n'
BAD = ["{t},0.5", "{t},0.5,0,7", "{t},fast,0", "{t},,0", "{t},0.5,1e9", "{t},nan,0", "soon,0.5,0", "1e30,0.5,0", "{t}"]
FAR = "9e8,0.5,0"  # 28 years later
IN_SHORT = settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


def kinds(log):
    return [warning.kind for warning in log.warnings]


def said(log, kind):
    return next(str(warning) for warning in log.warnings if warning.kind == kind)


@IN_SHORT
@given(
    good=st.integers(3, 12),
    bad=st.lists(st.tuples(st.integers(0, 12), st.sampled_from([*BAD, FAR])), min_size=1, max_size=3),
)
def test_bad_rows_are_skipped_wherever_they_are(tmp_path, good, bad):
    rows = [(f"{1 + 0.1 * i:.1f},0.25,0.{i}", True) for i in range(good)]
    for place, text in bad:
        rows.insert(min(place, len(rows)), (text.format(t="1.05"), False))
    first = next(i for i, (_, is_good) in enumerate(rows) if not is_good) + 2
    text = "\n".join(["t,v,w", *(row for row, _ in rows)]) + "\n"
    log = read_log(write_mapped(tmp_path, VELOCITIES + SKIP, wheels=text))
    np.testing.assert_allclose(log.streams["odometry"].w, [float(f"0.{i}") for i in range(good)])
    message = said(log, "bad_rows")
    assert message.startswith(f"{len(bad)} of {good + len(bad)} rows are skipped, the first: ")
    assert f"wheels.csv:{first}: " in message


@pytest.mark.parametrize("bad", BAD)
def test_a_bad_row_is_refused_with_the_key_that_skips_it(tmp_path, refused, bad):
    text = "t,v,w\n1,0,0\n" + bad.format(t="1.5") + "\n2,0,0\n"
    path = write_mapped(tmp_path, VELOCITIES, wheels=text)
    refused(path, "wheels.csv:3: ", 'bad_rows = "skip" in the manifest skips such rows')


def test_mostly_bad_rows_have_another_cause(tmp_path, refused):
    text = "t,v,w\n1,500,0\n2,600,0\n3,0,0\n"
    for options in (VELOCITIES, VELOCITIES + SKIP):
        message = refused(write_mapped(tmp_path, options, wheels=text), "wheels.csv:2: v is 500.0, expected")
        assert "skip" not in message


@IN_SHORT
@given(order=st.permutations(range(8)))
def test_rows_are_sorted(tmp_path, order):
    text = "t,v,w\n" + "".join(f"{1 + 0.1 * i:.1f},0.{i},0\n" for i in order)
    log = read_log(write_mapped(tmp_path, VELOCITIES + SORT, wheels=text))
    np.testing.assert_allclose(log.streams["odometry"].v, np.arange(8) / 10.0)
    late = np.array(order) < np.maximum.accumulate(order)
    assert ("sorted_rows" in kinds(log)) == late.any()
    if late.any():
        assert f"wheels.csv:{int(late.argmax()) + 2}: the time " in said(log, "sorted_rows")
        assert f" {np.count_nonzero(late)} such rows" in said(log, "sorted_rows")


def test_rows_out_of_order_are_refused_with_the_key_that_sorts_them(tmp_path, refused):
    sightings = (
        '[options.bearing_range]\nfile = "b.csv"\nunits = { t = "s" }\n'
        'columns = { t = "t", landmark = "id", range = "m" }\n'
    )
    wheels, key = "t,v,w\n1,0,0\n3,0,0\n2,0,0\n", 'order = "sort" in the manifest sorts the rows'
    refused(write_mapped(tmp_path, VELOCITIES, wheels=wheels), "wheels.csv:4: time is '2000000000 ns'", key)
    path = write_mapped(tmp_path, VELOCITIES + SORT + sightings, wheels=wheels, b="t,id,m\n2.9,A,1\n1.5,B,2\n")
    refused(path, "b.csv:3: ", "at most 0.5 s older", key)
    log = read_log(write_mapped(tmp_path, VELOCITIES + SORT + sightings + SORT))
    assert log.streams["bearing_range"].landmark == ["B", "A"]


def test_a_log_that_was_cut_off(tmp_path, refused):
    read = '[options.rfid]\nfile = "reads.jsonl"\nunits = { t = "s" }\ncolumns = { t = "t", epc_base64 = "e", antenna = "a" }\n'
    path = write_mapped(tmp_path, WHEELS + read, wheels="time_ms;speed;turn\n1000;0;0\n3000;0;0\n")
    reads = [{"t": 1.1, "e": "qrs=", "a": 1}, {"t": 1.2, "e": "?", "a": 1}, {"t": 1.3, "e": "qrs=", "a": []}]
    reads += [{"t": 1.4, "e": "qrs=", "a": 2}, {"t": 1.5, "e": "qrs=", "a": 2}, {"t": 1.6, "e": 5, "a": 2}]
    lines = [*map(json.dumps, reads), '{"t": 1.7, "e": "qr']
    (tmp_path / "run" / "reads.jsonl").write_text("\n".join(lines))
    refused(path, "reads.jsonl:3: a is [], expected a number or a text", 'bad_rows = "skip"')
    write_mapped(tmp_path, WHEELS + read + SKIP)
    refused(path, "reads.jsonl:2: e is '?', expected an EPC in base64")
    (tmp_path / "run" / "reads.jsonl").write_text("\n".join([lines[0], *lines]))
    log = read_log(path)
    assert log.streams["rfid"].antenna == ["1", "1", "2", "2"]
    assert said(log, "bad_rows").startswith("4 of 8 rows are skipped, the first: ")
    assert "reads.jsonl:3: e is '?'" in said(log, "bad_rows")


def test_a_first_row_without_header_that_was_cut_off(tmp_path):
    numbered = VELOCITIES.replace('t = "t", v = "v", w = "w"', 't = "1", v = "2", w = "3"') + "header = false\n"
    log = read_log(write_mapped(tmp_path, numbered + SKIP, wheels="1,0\n2,1,0\n3,2,0\n"))
    assert log.streams["odometry"].v.tolist() == [1.0, 2.0]
    assert "wheels.csv:1: row is '1,0'" in said(log, "bad_rows")


def test_the_motion_of_a_skipped_increment_is_unknown(tmp_path):
    moves = VELOCITIES.replace('v = "v", w = "w"', 'dx = "x", dy = "y", dtheta = "h"')
    text = "t,x,y,h\n1,0,0,0\n2,1,0,0\n3,?,0,0\n3.5,1,0,0\n4,1,0\n4.25,1,0,0\n"
    stream = read_log(write_mapped(tmp_path, moves + SKIP, wheels=text)).streams["odometry"]
    assert stream.dx.tolist() == [0.0, 1.0, 1.0, 1.0]
    np.testing.assert_allclose(stream.unknown, (0.0, 0.0, 1.5, 0.75))


def test_keys_of_the_native_format(native, refused):
    rows = "t_ns,v,w\n1000000000,0.5,0\n2000000000,400,0\n1500000000,0.5,0.25\n"
    (native / "odometry.csv").write_text(rows)
    run = (native / "run.toml").read_text()
    refused(native, "odometry.csv:3: v is 400.0", 'bad_rows = "skip" in run.toml skips such rows')
    (native / "run.toml").write_text(SKIP + run)
    assert read_log(native).streams["odometry"].w.tolist() == [0.0, 0.25]
    (native / "odometry.csv").write_text(rows.replace("400", "0.4"))
    refused(native, "odometry.csv:4: time is '1500000000 ns'", 'order = "sort" in run.toml sorts the rows')
    (native / "run.toml").write_text(SORT + run)
    assert read_log(native).streams["odometry"].w.tolist() == [0.0, 0.25, 0.0]


def test_rounds_that_reads_name_by_number(native, refused):
    (native / "inventories.csv").write_text("t_ns,antenna,duration\n1,l,x\n1200000000,l,0.1\n1400000000,l,0.1\n")
    (native / "rfid.csv").write_text("t_ns,antenna,epc,inventory\n1150000000,l,E1,2\n")
    (native / "run.toml").write_text(SKIP + (native / "run.toml").read_text())
    refused(
        native, "inventories.csv: some rows were skipped or sorted, but the reads refer to these rows by row number"
    )


def test_messages_are_skipped_and_sorted(maker, read_drive):
    add_imu(maker, [(0.0, 0.0, math.nan if i == 1 else 0.1 * i) for i in range(COUNT)])
    for arrival, i in enumerate((0, 2, 1, 3)):
        pose = (0.1 * i, 0.0, math.nan) if i == 3 else (0.1 * i, 0.0, 0.0)
        maker.odometry("/truth", T0 + 100 * MS * i, pose, delay=100 * MS * (9 + arrival - i))
    rules = {"bad_rows": "skip", "order": "sort"}
    log = read_drive(maker, imu={"topic": "/imu", **rules}, reference={"topic": "/truth", **rules})
    np.testing.assert_allclose(log.streams["imu"].w, (0.0, 0.2, 0.3, 0.4))
    np.testing.assert_allclose(log.reference.poses[:, 0], (0.0, 0.1, 0.2))
    messages = [str(warning) for warning in log.warnings if warning.kind in ("bad_rows", "sorted_rows")]
    assert "/imu:2: turn rate about z is nan" in messages[1] + messages[0]
    assert any("/truth:4: qz is nan" in message for message in messages)
    assert any("/truth:3: the time " in message and "1 such rows" in message for message in messages)


def test_messages_are_refused_with_the_keys(maker, refuse_drive):
    add_imu(maker, [(0.0, 0.0, math.nan if i == 1 else 0.0) for i in range(COUNT)])
    refuse_drive(maker, "/imu:2: turn rate about z is nan", 'bad_rows = "skip"', imu={"topic": "/imu"})


def test_reads_without_an_epc_are_skipped_in_their_round(maker, read_drive):
    for i in range(3):
        reads = [("E1", 1, -50.0, 0.0, T0 + 100 * MS * i), ("" if i == 1 else "E2", 1, -50.0, 0.0, T0 + 100 * MS * i)]
        maker.reads("/tags", T0 + 100 * MS * i, reads)
    fields = {"epc": "reads[].epc", "antenna": "reads[].antenna"}
    log = read_drive(maker, rfid={"topic": "/tags", "fields": fields, "rounds": "message", "bad_rows": "skip"})
    stream = log.streams["rfid"]
    assert stream.epc == ["E1", "E2", "E1", "E1", "E2"]
    assert stream.number.tolist() == [0, 0, 1, 2, 2]
    assert "/tags:2: epc is ''" in said(log, "bad_rows")


def wheels(rates):
    """A table of velocities with these turn rates, ten a second."""
    return "t,v,w\n" + "".join(f"{0.1 * i:.1f},0.5,{w}\n" for i, w in enumerate(rates))


def test_a_turn_rate_that_jumps(tmp_path):
    rates = np.where(np.arange(40) == 20, 0.5 - 20 * math.pi, 0.5)
    assert "odometry_jumps" not in kinds(read_log(write_mapped(tmp_path, VELOCITIES, wheels=wheels(rates))))
    log = read_log(write_mapped(tmp_path, VELOCITIES + SKIP))
    assert len(log.streams["odometry"].t) == 39
    expected = (
        "the turn rate of the odometry jumps to -62.3 rad/s at t = 2.000 s, between rows with 0.50 and 0.50 rad/s"
    )
    assert said(log, "skipped_jumps").startswith(expected)


@pytest.mark.parametrize("row", [0, 1, 38, 39])
def test_a_jump_at_an_end(tmp_path, row):
    rates = np.where(np.arange(40) == row, -60.0, 0.5)
    log = read_log(write_mapped(tmp_path, VELOCITIES + SKIP, wheels=wheels(rates)))
    assert log.streams["odometry"].w.tolist() == [0.5] * 39


def test_a_gyro_that_jumps(native):
    rows = "".join(f"{1_000_000_000 + 100_000_000 * i},{70 if i == 5 else 0.25}\n" for i in range(10))
    (native / "imu.csv").write_text("t_ns,w\n" + rows)
    (problem,) = [p for p in summarize(read_log(native)).problems if p.kind == "imu_jumps"]
    assert str(problem).startswith("the turn rate of the gyro jumps to 70.0 rad/s at t = 0.500 s")
    assert str(problem).endswith('(such rows: 1); bad_rows = "skip" skips them')
    (native / "run.toml").write_text(SKIP + (native / "run.toml").read_text())
    assert read_log(native).streams["imu"].w.tolist() == [0.25] * 9


def test_a_stamp_of_another_year(tmp_path, refused):
    text = "t,v,w\n1,0.5,0\n1700000000,0.5,0\n1700000001,0.5,0\n1700000002,0.5,0\n"
    refused(write_mapped(tmp_path, VELOCITIES, wheels=text), "wheels.csv:2: stamp is", 'bad_rows = "skip"')
    assert len(read_log(write_mapped(tmp_path, VELOCITIES + SKIP)).streams["odometry"].t) == 3


def test_an_increment_that_jumps(tmp_path):
    moves = VELOCITIES.replace('v = "v", w = "w"', 'dx = "x", dy = "y", dtheta = "h"')
    rows = "".join(f"{0.1 * i:.1f},{20 if i == 5 else 0.05},0,0.05\n" for i in range(12))
    stream = read_log(write_mapped(tmp_path, moves + SKIP, wheels="t,x,y,h\n" + rows)).streams["odometry"]
    assert isinstance(stream, IncrementStream)
    assert len(stream.t) == 11
    np.testing.assert_allclose(stream.unknown, np.where(np.arange(11) == 5, 0.2, 0.0), atol=1e-9)


@given(
    rates=st.lists(st.sampled_from((0.0, 0.5, -0.5, 3.0, 63.0, -63.0)), min_size=2, max_size=30),
    length=st.integers(1, 29),
)
def test_later_rows_do_not_make_an_earlier_one_a_jump(rates, length):
    def rows(count):
        t = 0.1 * np.arange(count)
        turned = np.array(rates[:count])
        gyro, moved = YawRateStream(t, turned), IncrementStream(t, 0.05 * turned, 0.0 * t, 0.1 * turned)
        return [[(jump.row, jump.what) for jump in jumps(stream)] for stream in (gyro, moved)]

    whole, part = rows(len(rates)), rows(min(length, len(rates)))
    assert part == [[(row, what) for row, what in found if row < length] for found in whole]


@IN_SHORT
@given(seed=st.integers(0, 1000), top=st.floats(0.1, 8.0))
def test_motion_of_a_robot_has_no_jumps(tmp_path, seed, top):
    """A robot that accelerates at 30 rad/s^2, whatever its commands."""
    rng = np.random.default_rng(seed)
    rates, goal = [0.0], 0.0
    for _ in range(60):
        goal = rng.uniform(-top, top) if rng.random() < 0.3 else goal
        rates.append(rates[-1] + float(np.clip(goal - rates[-1], -3.0, 3.0)))
    log = read_log(write_mapped(tmp_path, VELOCITIES + SKIP, wheels=wheels(rates)))
    assert "skipped_jumps" not in kinds(log)
