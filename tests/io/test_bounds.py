"""What lies within the bounds of a column is read as it is; what does not is told with file, row and column."""

import math
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from refusal import refusal

from factorgraph_loc import IncrementStream, InputError, StartPose, load
from factorgraph_loc.files.columns import LATEST, STAMP
from factorgraph_loc.io.checks import require_bounds, require_one_span
from factorgraph_loc.sensors.camera.measurement import SIGHTINGS
from factorgraph_loc.sensors.landmarks.measurement import BEARING_RANGE
from factorgraph_loc.sensors.odometry.measurement import IMU, INCREMENTS, VELOCITIES
from factorgraph_loc.sensors.rfid.stream import INVENTORIES, RFID

UNIX = 1_700_000_000_000_000_000
ROW = {"landmark": "A", "antenna": "left", "epc": "E1", "file": "a.png", "duration": 1.0}
NATIVE = [VELOCITIES, INCREMENTS, IMU, BEARING_RANGE, RFID, INVENTORIES, SIGHTINGS]
NUMBERS = [
    (table, column)
    for table in NATIVE
    for column in table.columns
    if column.kind == "number" and column.name != "inventory"
]


def write(folder, table, column, value, kind):
    """A log whose ``table`` has ``value`` in its second row; its file."""
    names = [c.name for c in table.columns if c.name not in ("inventory", STAMP.name)]
    rows = {
        name: [ROW.get(name, 0.5 if name == "range" else None if name in ("phase", "frequency", "rssi") else 0.0)] * 2
        for name in names
    }
    rows[column.name] = [rows[column.name][0], value]
    frame = pl.DataFrame({STAMP.name: [UNIX, UNIX + 10**9], **rows}, strict=False)
    if kind == "csv":
        frame.write_csv(folder / f"{table.name}.csv")
    else:
        frame.write_parquet(folder / f"{table.name}.parquet")
    if table.name != "odometry":
        (folder / "odometry.csv").write_text(f"t_ns,v,w\n{UNIX},0,0\n{UNIX + 10**9},0,0\n")
    (folder / "run.toml").write_text("")
    return folder / f"{table.name}.{kind}"


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(place=st.sampled_from(NUMBERS), share=st.floats(0.0, 1.0), kind=st.sampled_from(["csv", "parquet"]))
@example(place=(INCREMENTS, INCREMENTS["dx"]), share=0.0, kind="csv")
@example(place=(INCREMENTS, INCREMENTS["dx"]), share=1.0, kind="parquet")
def test_what_lies_within_the_bounds_comes_back(tmp_path_factory, place, share, kind):
    table, column = place
    value = (1.0 - share) * column.low + share * column.high
    folder = tmp_path_factory.mktemp("log")
    write(folder, table, column, value, kind)
    (log,) = load(str(folder))
    stream = log.streams["rfid" if table.name == "inventories" else table.name]
    if table is BEARING_RANGE and column.name == "range" and value < 1e-3:
        assert any(warning.kind == "not_positive" for warning in log.warnings)
    elif table is not INVENTORIES:
        assert float(getattr(stream, column.name)[-1]) == value


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    place=st.sampled_from(NUMBERS),
    value=st.floats(allow_nan=False) | st.integers(0, 400).map(lambda power: 10.0 ** min(power, 308)),
    kind=st.sampled_from(["csv", "parquet"]),
)
@example(place=(VELOCITIES, VELOCITIES["v"]), value=math.inf, kind="parquet")
def test_what_lies_outside_is_told_with_file_row_and_column(tmp_path_factory, place, value, kind):
    table, column = place
    if column.low <= value <= column.high:
        value = math.nextafter(column.high, math.inf)
    folder = tmp_path_factory.mktemp("log")
    file = write(folder, table, column, value, kind)
    row = 3 if kind == "csv" else 2
    refusal(lambda: load(str(folder)), f"{file.name}:{row}: {column.name} is ")


@pytest.mark.parametrize("first", [0, UNIX - 10**18, UNIX + 31 * 86_400 * 10**9, -LATEST])
def test_a_stamp_that_is_far_from_all_others_is_told_with_its_row(native, refused, first):
    rows = "".join(f"{UNIX + i * 10**8},0.1,0\n" for i in range(20))
    (native / "bearing_range.csv").unlink()
    (native / "reference.tum").unlink()
    late = first > UNIX
    text = f"t_ns,v,w\n{rows}{first},0,0\n" if late else f"t_ns,v,w\n{first},0,0\n{rows}"
    (native / "odometry.csv").write_text(text)
    refused(native, f"odometry.csv:{22 if late else 2}: stamp is '{first} ns'", "at most 30 days from all others")


def test_bounds_are_told_in_the_unit_of_the_file(hall, refused):
    (hall.parent / "run" / "wheels.csv").write_text("time_ms;speed;turn\n1000;361;90\n1500;1,8;0\n")
    refused(hall, "wheels.csv:2: speed is 361.0, expected a finite number of km/h in -360 to 360")


def test_what_no_reader_looked_at_is_found_in_the_log(native, one):
    log = one(native)
    t = log.streams["odometry"].t
    moves = IncrementStream(t, np.array((0.0, 2000.0, 0.0)), np.zeros(3), np.zeros(3))
    with pytest.raises(InputError, match=r"hall: odometry at 0.500 s: dx is 2000.0, expected a finite number of m"):
        require_bounds(replace(log, streams={"odometry": moves}))
    with pytest.raises(
        InputError, match=r"hall: the start pose is -1700000000 s after the first timestamp, expected one at"
    ):
        require_one_span(replace(log, start=StartPose(-1.7e9, np.zeros(3), np.ones(3))))
    with pytest.raises(InputError, match=r"hall: start at 0.000 s: x is 1e\+300, expected"):
        require_bounds(replace(log, start=StartPose(0.0, np.array((1e300, 0.0, 0.0)), np.ones(3))))
    poses = np.array(log.reference.poses)
    poses[1, 0] = 1e12
    with pytest.raises(InputError, match=r"hall: reference at 0.500 s: x is 1000000000000.0, expected"):
        require_bounds(replace(log, reference=replace(log.reference, poses=poses)))
