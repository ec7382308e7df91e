"""The native format: what is read, what is refused and how, and that what is written comes back."""

import dataclasses
import re
import tomllib
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from factorgraph_loc import InputError, Log, Rig, StartPose, Trajectory, World, load, read_world
from factorgraph_loc.files.models import parse_model
from factorgraph_loc.io.native.native import RunFile, write_native
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings, BearingRangeStream, Landmark
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream, YawRateStream
from factorgraph_loc.sensors.odometry.settings import ImuSettings


def test_what_is_read(native, one):
    log = one(native)
    assert (log.name, log.rig.name, log.t0_ns, log.warnings) == ("hall", "cart", 10**9, ())
    np.testing.assert_array_equal(log.streams["odometry"].t, (0.0, 0.5, 1.0))
    np.testing.assert_array_equal(log.streams["odometry"].v, (0.5, 0.5, 0.0))
    sightings = log.streams["bearing_range"]
    assert sightings.landmark == ["A", "B", "A"]
    np.testing.assert_array_equal(sightings.range, (2.5, np.nan, 2.25))
    np.testing.assert_array_equal(sightings.bearing, (0.3, -0.2, np.nan))
    np.testing.assert_allclose(log.reference.poses, ((0, 0, 0), (0.25, 0, 0)))


def test_increments_imu_start_and_files_beside(native, one):
    (native / "odometry.csv").write_text("dtheta,dy,dx,t_ns\n0,0,0,1000000000\n0.1,0.01,0.2,1500000000\n")
    (native / "imu.csv").write_text("t_ns,w\n900000000,0.25\n")
    (native / "cart.rig.toml").write_text('name = "beside"\n')
    (native / "run.toml").write_text(
        'rig = "cart.rig.toml"\nhas_heading = false\n[metadata]\nsite = "hall"\n'
        "[start]\nx = 1\ny = 2\nheading = 0.5\nsigma_position = 0.1\nsigma_heading = 0.05\nt_ns = 1100000000\n"
    )
    log = one(native)
    assert (log.rig.name, log.t0_ns, log.metadata) == ("beside", 900_000_000, {"site": "hall"})
    np.testing.assert_array_equal(log.streams["odometry"].dx, (0.0, 0.2))
    np.testing.assert_array_equal(log.streams["imu"].w, (0.25,))
    assert log.start.t == 0.2
    np.testing.assert_array_equal(log.start.sigmas, (0.1, 0.1, 0.05))
    assert not log.reference.has_heading


BAD_ODOMETRY = {
    "nan": ("t_ns,v,w\n1,0.5,0\n2,nan,0\n", ":3: v is 'nan'", "finite"),
    "infinity": ("t_ns,v,w\n1,0.5,-inf\n", ":2: w is '-inf'", "finite"),
    "empty field": ("t_ns,v,w\n1,,0\n", ":2: v is ''", "finite"),
    "word": ("t_ns,v,w\n1,fast,0\n", ":2: v is 'fast'", "a number"),
    "seconds for nanoseconds": ("t_ns,v,w\n1.5,0,0\n", ":2: t_ns is '1.5'", "whole number of nanoseconds"),
    "huge stamp": ("t_ns,v,w\n99999999999999999999,0,0\n", ":2: t_ns", "in -4.6e+18 to 4.6e+18"),
    "short row": ("t_ns,v,w\n1,0.5,0\n\n2,0.5\n", ":4: row is '2,0.5'", "3 values: t_ns,v,w"),
    "no header": ("1,0.5,0\n2,0.5,0\n", ":1: column t_ns is missing", "expected t_ns,v,w or t_ns,dx,dy,dtheta"),
    "column missing": ("t_ns,v\n1,0.5\n", ":1: column w is missing"),
    "column misspelt": ("t_ns,dx,dy,dteta\n1,0,0,0\n", "column dtheta is missing", "did you mean dteta?"),
    "column twice": ("t_ns,v,w,w\n1,0,0,0\n", ":1: header", "each column once"),
    "time going back": ("t_ns,v,w\n1,0,0\n5,0,0\n4,0,0\n", ":4: time is '4 ns'", "5 ns"),
    "empty file": ("", "odometry.csv: is empty", "expected a header"),
    "no rows": ("t_ns,v,w\n", "has no odometry"),
    "open quote": ('t_ns,v,w\n1,"0,0\n', "is not CSV"),
}


@pytest.mark.parametrize(("text", "fragments"), [(t, f) for t, *f in BAD_ODOMETRY.values()], ids=list(BAD_ODOMETRY))
def test_bad_odometry(native, refused, text, fragments):
    (native / "odometry.csv").write_text(text)
    refused(native, *fragments)


HEADER = "t_ns,landmark,range,bearing\n"


def test_ranges_that_cannot_be_are_left_out_and_bearings_beside_them_kept(native, one):
    rows = "1100000000,A,1.5,0\n1200000000,A,0,\n1200000000,B,-3,0.2\n1300000000,A,1.4,0.1\n"
    (native / "bearing_range.csv").write_text(HEADER + rows)
    log = one(native)
    seen = log.streams["bearing_range"]
    assert list(seen.landmark) == ["A", "B", "A"]
    np.testing.assert_array_equal(seen.range, (1.5, np.nan, 1.4))
    np.testing.assert_array_equal(seen.bearing, (0.0, 0.2, 0.1))
    assert any(
        "bearing_range.csv:3: range is 0: 2 ranges that are not above 0 are skipped" in str(w) for w in log.warnings
    )


BAD_FILES = {
    "neither range nor bearing": (
        "bearing_range.csv",
        HEADER + "1,A,1,0\n2,A,,\n",
        "bearing_range.csv:3: row",
        "a range, a bearing or both",
    ),
    "no name": ("bearing_range.csv", HEADER + "1,,1,0\n", "bearing_range.csv:2: landmark is ''", "name of a landmark"),
    "too late": (
        "bearing_range.csv",
        HEADER + "2000000000,A,1,0\n1400000000,A,1,0\n",
        "bearing_range.csv:3: time",
        "at most 0.5 s older",
    ),
    "imu going back": ("imu.csv", "t_ns,w\n5,0\n4,0\n", "imu.csv:3: time"),
    "reference going back": ("reference.tum", "2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "reference.tum:2: time"),
    "unknown key": ("run.toml", "[rig]\nsensor = ['odometry']\n", "unknown key sensor", "did you mean sensors?"),
    "rig outside": ("run.toml", 'rig = "../other.rig.toml"\n', "run.toml: path '../other.rig.toml' leaves its folder"),
}


@pytest.mark.parametrize(
    ("name", "text", "fragments"), [(n, t, f) for n, t, *f in BAD_FILES.values()], ids=list(BAD_FILES)
)
def test_bad_files(native, refused, name, text, fragments):
    (native / name).write_text(text)
    refused(native, *fragments)


def test_a_table_that_links_outside(native, refused, tmp_path):
    (native / "odometry.csv").rename(tmp_path / "elsewhere.csv")
    (native / "odometry.csv").symlink_to(tmp_path / "elsewhere.csv")
    refused(native, "odometry.csv", "leaves its folder")


def test_duplicate_stamps_the_last_wins(native, one):
    (native / "odometry.csv").write_text("t_ns,v,w\n0,1,0\n0,2,0\n1,3,0\n1,4,0\n1,5,0\n")
    log = one(native)
    np.testing.assert_array_equal(log.streams["odometry"].v, (2.0, 5.0))
    assert "odometry.csv: 3 rows have the timestamp of the row after them" in str(log.warnings[0])


def test_increments_of_one_stamp_are_one_motion(native, one):
    """Each metre of the file is a metre of the log, whatever its stamp; a turn in between counts too."""
    rows = "t_ns,dx,dy,dtheta\n0,0,0,0\n1000,1,0,0\n1000,1,0,0.5\n2000,1,0,0\n2000,0,1,0\n2000,0,0,-0.5\n"
    (native / "odometry.csv").write_text(rows)
    log = one(native)
    odometry = log.streams["odometry"]
    assert len(odometry.t) == 3
    moves = np.column_stack((odometry.dx, odometry.dy, odometry.dtheta))
    np.testing.assert_allclose(moves, ((0, 0, 0), (2, 0, 0.5), (1, 1, -0.5)), atol=1e-12)
    assert "odometry.csv: 3 increments have the timestamp of the row before them and are composed with it" in str(
        log.warnings[0]
    )


def test_duplicate_sightings_the_last_wins(native, one):
    with (native / "bearing_range.csv").open("a") as file:
        file.write("1600000000,A,3,\n1600000000,B,4,\n")
    log = one(native)
    np.testing.assert_array_equal(log.streams["bearing_range"].range, (2.5, np.nan, 3.0, 4.0))
    assert "bearing_range.csv: 1 rows are skipped, because a later row has the same landmark" in str(log.warnings[0])


def test_late_sightings_keep_their_place(native, one):
    (native / "bearing_range.csv").write_text(HEADER + "1600000000,A,1,0\n1100000000,A,2,0\n1700000000,A,3,0\n")
    log = one(native)
    np.testing.assert_array_equal(log.streams["bearing_range"].t, (0.6, 0.1, 0.7))
    assert "1 rows are late, by at most 0.500 s" in str(log.warnings[0])


WARNED = {
    "gap in odometry": (
        "odometry.csv",
        "t_ns,v,w\n1000000000,0,0\n61000000000,0,0\n",
        "a gap above 5 s, the longest 60.0 s",
    ),
    "unknown landmarks": (
        "bearing_range.csv",
        HEADER + "1000000000,C,1,0\n1000000000,A,1,0\n",
        "1 rows name landmarks",
    ),
    "before the first odometry": (
        "bearing_range.csv",
        HEADER + "999999999,A,1,0\n",
        "1 rows come before the first odometry",
    ),
    "no sightings": ("bearing_range.csv", HEADER, "bearing_range.csv: contains no rows"),
    "of a later version": ("sonar.csv", "x\n", "this version does not read sonar.csv"),
    "no rig": ("run.toml", "[world.landmarks]\nA = { x = 1, y = 1 }\nB = { x = 1, y = 1 }\n", "no rig is given"),
}


@pytest.mark.parametrize(("name", "text", "fragment"), WARNED.values(), ids=list(WARNED))
def test_warned_and_kept(native, one, name, text, fragment):
    (native / name).write_text(text)
    (warning,) = one(native).warnings
    assert fragment in str(warning)


def test_parquet_is_read_too_but_not_both(native, one, refused):
    expected = one(native).streams["bearing_range"]
    pl.read_csv(native / "bearing_range.csv").write_parquet(native / "bearing_range.parquet")
    refused(native, "holds both bearing_range.csv and bearing_range.parquet")
    (native / "bearing_range.csv").unlink()
    found = one(native).streams["bearing_range"]
    np.testing.assert_array_equal(found.range, expected.range)
    assert found.landmark == expected.landmark


BAD_PARQUET = {
    "not Parquet": (None, "is not a Parquet file"),
    "column missing": ({"t_ns": [1], "v": [0.5]}, "column w is missing"),
    "stamps in seconds": ({"t_ns": [1.5], "v": [0.5], "w": [0.0]}, "t_ns is of type Float64"),
    "stamp missing": ({"t_ns": [1, None], "v": [0.5, 0.5], "w": [0.0, 0.0]}, ":2: t_ns is None"),
    "text": ({"t_ns": [1], "v": ["fast"], "w": [0.0]}, "v is of type String"),
}


@pytest.mark.parametrize(("columns", "fragment"), BAD_PARQUET.values(), ids=list(BAD_PARQUET))
def test_bad_parquet(native, refused, columns, fragment):
    (native / "odometry.csv").unlink()
    file = native / "odometry.parquet"
    if columns is None:
        file.write_text("t_ns,v,w\n")
    else:
        pl.DataFrame(columns).write_parquet(file)
    refused(native, "odometry.parquet", fragment)


rates = st.floats(-100.0, 100.0)
finite = st.floats(-1e7, 1e7)
stamps = st.lists(st.integers(0, 10**13), min_size=1, max_size=8, unique=True).map(sorted)
names = st.text(st.characters(exclude_categories=("Cs", "Cc")), min_size=1, max_size=5)


@st.composite
def logs(draw: st.DrawFn) -> Log:
    t0_ns = draw(st.integers(-(10**18), 2 * 10**18))

    def column(n: int, values: st.SearchStrategy[float] = rates) -> np.ndarray:
        return np.array(draw(st.lists(values, min_size=n, max_size=n)), dtype=float)

    def times() -> np.ndarray:
        return np.array(draw(stamps)) / 1e9

    t = times()
    t[0] = 0.0
    n = len(t)
    odometry = (
        VelocityStream(t, column(n), column(n))
        if draw(st.booleans())
        else IncrementStream(t, column(n), column(n), column(n))
    )
    t = times()
    n = len(t)
    ranges = column(n, st.one_of(st.floats(0.01, 1e3), st.just(np.nan)))
    bearings = np.where(np.isnan(ranges), 0.25, column(n, st.one_of(st.floats(-6, 6), st.just(np.nan))))
    landmarks = [draw(names) for _ in range(n)]
    t_imu, t_reference = times(), times()
    poses = np.column_stack([column(len(t_reference), st.floats(-3, 3)) for _ in range(3)])
    return Log(
        name=draw(names),
        rig=Rig(
            sensors=("odometry", "imu", "bearing_range"),
            imu=ImuSettings(bias=0.01),
            bearing_range=BearingRangeSettings(range_sigma=0.2),
        ),
        world=World(landmarks={name: Landmark(x=draw(finite), y=draw(finite)) for name in landmarks}),
        streams={
            "odometry": odometry,
            "bearing_range": BearingRangeStream(t, landmarks, ranges, bearings),
            "imu": YawRateStream(t_imu, column(len(t_imu))),
        },
        reference=Trajectory(t_reference, poses, has_heading=draw(st.booleans())),
        start=StartPose(0.5, np.array((1.0, 2.0, 0.5)), np.array((0.1, 0.1, 0.2))),
        t0_ns=t0_ns,
        metadata={"licence": draw(names)},
    )


@given(log=logs(), format=st.sampled_from(["csv", "parquet"]))
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
def test_what_is_written_comes_back(tmp_path_factory, log, format):
    folder = tmp_path_factory.mktemp("logs") / "out"
    write_native(log, folder, format=format)
    (back,) = load(str(folder))
    assert (back.name, back.rig, back.world, back.t0_ns) == (log.name, log.rig, log.world, log.t0_ns)
    assert back.metadata == log.metadata
    assert all(w.kind in ("gaps", "early_rows") for w in back.warnings)
    assert set(back.streams) == set(log.streams)
    for name, stream in log.streams.items():
        assert type(back.streams[name]) is type(stream)
        for field in dataclasses.fields(stream):
            np.testing.assert_array_equal(getattr(back.streams[name], field.name), getattr(stream, field.name))
    np.testing.assert_array_equal(back.reference.t, log.reference.t)
    np.testing.assert_allclose(back.reference.poses, log.reference.poses, atol=1e-9)
    assert back.reference.has_heading == log.reference.has_heading
    np.testing.assert_array_equal(back.start.sigmas, log.start.sigmas)
    assert back.start.t == log.start.t


def test_writing_refuses_a_folder_that_holds_something(native, one):
    before = sorted(native.iterdir())
    with pytest.raises(InputError, match="not an empty folder"):
        write_native(one(native), native)
    assert sorted(native.iterdir()) == before


def test_a_write_that_fails_leaves_nothing(native, one, tmp_path):
    log = one(native)
    broken = dataclasses.replace(log, streams={**log.streams, "sonar": object()})
    out = tmp_path / "new"
    with pytest.raises(InputError, match="no sensor is called"):
        write_native(broken, out)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["hall"]


def test_the_name_of_a_log_is_no_path(native, one, tmp_path):
    write_native(dataclasses.replace(one(native), name="../up"), tmp_path / "out")
    assert one(tmp_path / "out").name == "../up"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["hall", "out"]


def test_the_example_of_the_documentation(tmp_path, one, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "log-format.md").read_text()
    blocks = re.findall(r"^`([a-z_.]+)`:\n\n```[a-z]+\n(.*?)```", page, re.DOTALL | re.MULTILINE)
    (tmp_path / "hall").mkdir()
    for name, text in blocks:
        (tmp_path / "hall" / name).write_text(text)
    log = one(tmp_path / "hall")
    assert (len(blocks), log.warnings, len(log.reference)) == (7, (), 2)
    rows = {name: len(stream.t) for name, stream in log.streams.items()}
    assert rows == {"odometry": 3, "bearing_range": 3, "rfid": 3}
    # the run.toml with every key, and the lines of Python
    whole = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)[0]
    parse_model(RunFile, tomllib.loads(whole), "run.toml")
    monkeypatch.chdir(tmp_path)
    for lines in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(lines, "log-format.md", "exec"), {})
    assert read_world(tmp_path / "markers.world.toml").points.names == ("marker-7", "marker-9")
    assert (tmp_path / "copy" / "odometry.parquet").is_file()
