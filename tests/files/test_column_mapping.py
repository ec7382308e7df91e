"""Tables of other programs: stamps, numbers and columns as they stand there."""

import math
from datetime import UTC, datetime, timedelta, timezone
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusal import refusal

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.cells import SECONDS, Cells, iso_nanoseconds
from factorgraph_loc.files.column_mapping import ColumnMapping, read_mapped
from factorgraph_loc.files.columns import POINTS, POSES
from factorgraph_loc.sensors.landmarks.measurement import BEARING_RANGE
from factorgraph_loc.sensors.odometry.measurement import VELOCITIES
from factorgraph_loc.sensors.rfid.map import TAGS
from factorgraph_loc.sensors.tables import all_tables

STAMPS = st.integers(-(2**61), 2**61)


def mapped(texts, **more):
    """A column ``c`` that is mapped to ``t``."""
    rows = np.arange(2, len(texts) + 2)
    return Cells(Path("a.csv"), rows, {"t": texts}, {"t": "c"}, **more)


@given(stamps=st.lists(STAMPS, min_size=1, max_size=5), unit=st.sampled_from(list(SECONDS)), mark=st.sampled_from(".,"))
def test_stamps_are_exact_in_each_unit(stamps, unit, mark):
    for stamp in stamps:  # each alone, as they lie further apart than those of one log
        text = f"{Decimal(stamp).scaleb(-SECONDS[unit]):f}".replace(".", mark)
        assert mapped([text], units={"t": unit}, decimal=mark).stamps("t").tolist() == [stamp]


@given(stamp=st.integers(0, 4 * 10**18), minutes=st.integers(-14 * 60, 14 * 60), separator=st.sampled_from("T "))
def test_dates_are_exact_in_each_zone(stamp, minutes, separator):
    zone = timezone(timedelta(minutes=minutes))
    moment = datetime.fromtimestamp(stamp // 10**9, UTC).astimezone(zone)
    date, clock = moment.date(), moment.replace(tzinfo=None).time()
    offset = f"{'-' if minutes < 0 else '+'}{abs(minutes) // 60:02d}:{abs(minutes) % 60:02d}"
    assert iso_nanoseconds(f"{date}{separator}{clock}.{stamp % 10**9:09d}{offset}") == stamp


@pytest.mark.parametrize("text", ["1,700", "1e30", "nan", "inf", "", "12:00", "0x10"])
def test_what_is_no_stamp(text):
    with pytest.raises(InputError, match=r"a\.csv:2: c is .*, expected a number of s"):
        mapped([text], units={"t": "s"}).stamps("t")


@pytest.mark.parametrize("text", ["1700000000", "2026-13-01T00:00:00", "4/9/2026", ""])
def test_what_is_no_date(text):
    with pytest.raises(InputError, match="expected a date and time"):
        mapped([text], units={"t": "iso"}).stamps("t")


@pytest.fixture
def read(tmp_path):
    """Reads a file of this content by a mapping."""

    def call(content, name="a.csv", optional=(), **mapping):
        (tmp_path / name).write_text(content, encoding="utf-8")
        told = ColumnMapping(file=name, **mapping)
        return read_mapped(tmp_path / name, told, (tuple(f for f in told.columns if f not in optional),), optional)

    return call


@pytest.mark.parametrize(
    ("content", "more"),
    [
        ("x,y\n1,2\n3,4\n", {}),
        ("\ufeffx , y\r\n1, 2\r\n\r\n3,4\r\n", {}),
        ("# made by hand\n# x,y\n1,2\n# later\n3,4\n", {}),
        ("// x, y\n1, 2\n3, 4", {}),
        ('x,note,y\n1,"a, b",2\n3,,4\n', {}),
        ("x;y\n1,0;2,0\n3;4\n", {"separator": ";", "decimal": ","}),
        ("y\tx\n2\t1\n4\t3\n", {"separator": "\t"}),
        ("x  y\n1   2\n  3 4\n", {"separator": " "}),
    ],
)
def test_ways_to_write_a_table(read, content, more):
    found = read(content, columns={"a": "x", "b": "y"}, **more)
    np.testing.assert_array_equal(found.numbers("a", POSES["x"]), (1.0, 3.0))
    np.testing.assert_array_equal(found.numbers("b", POSES["x"]), (2.0, 4.0))


def test_columns_by_number_and_by_factor(read):
    found = read("1,2\n3,4\n", columns={"a": "2"}, units={"a": 0.5}, header=False)
    np.testing.assert_array_equal(found.numbers("a", POSES["x"]), (1.0, 2.0))
    assert found.rows.tolist() == [1, 2]


def test_optional_columns_may_be_missing(read):
    found = read("x\n1\n", columns={"a": "x", "b": "y"}, optional=("b",))
    assert list(found.columns) == ["a"]


@pytest.mark.parametrize("where", [{"kind": "tag"}, {"kind": ("tag", "none"), "n": (1, 2)}, {"ok": True}])
@pytest.mark.parametrize("form", ["csv", "jsonl"])
def test_rows_with_values_of_other_columns(read, form, where):
    entries = [("tag", 1, "true", 3.5), ("gpi", 1, "false", 4.5), ("tag", 2, "true", 5.5)]
    lines = [f'{{"kind": "{kind}", "n": {n}, "ok": {ok}, "x": {x}}}' for kind, n, ok, x in entries]
    table = ["kind,n,ok,x", *(f"{kind},{n},{ok},{x}" for kind, n, ok, x in entries)]
    found = read("\n".join(table if form == "csv" else lines), f"a.{form}", columns={"a": "x"}, where=where)
    np.testing.assert_array_equal(found.numbers("a", POSES["x"]), (3.5, 5.5))
    assert found.unwanted == 1
    assert set(found.left_out) == {"kind", "n", "ok"} - set(where)


def test_rows_of_other_kinds_may_have_other_numbers_of_columns(read):
    table = "range 0.5 7 8 9\nodom 1 2\nrange 0.7 4 5 6\nodom 3 4\n"
    given = {"header": False, "separator": " "}
    found = read(table, columns={"a": "2"}, where={"1": "odom"}, **given)
    np.testing.assert_array_equal(found.numbers("a", TAGS["z"]), (1.0, 3.0))
    assert (found.unwanted, found.left_out) == (2, ("3",))
    assert read(table, columns={"a": "5"}, where={"1": "range"}, **given).numbers("a", TAGS["z"]).tolist() == [9.0, 6.0]
    with pytest.raises(InputError, match=r"a.csv:2: row is 'odom,1', expected 3 values: 1,2,3"):
        read("odom 1 2\nodom 1\n", columns={"a": "2"}, where={"1": "odom"}, **given)


def test_json_lines_of_several_kinds(read):
    lines = '{"p": {"x": 1}}\n\n[{"p": {"x": 2, "y": null}}, {"other": 3}]\n{"p": {"x": 3, "y": "4"}}\n'
    found = read(lines, "a.jsonl", optional=("b",), columns={"a": "p.x", "b": "p.y"})
    assert found.passed == 1
    assert found.rows.tolist() == [1, 3, 4]
    np.testing.assert_array_equal(found.numbers("b", TAGS["z"]), (np.nan, np.nan, 4.0))


@pytest.mark.parametrize(
    ("content", "mapping", "fragments"),
    [
        ("x,x\n1,2\n", {"columns": {"a": "x"}}, ("a.csv:1", "'x' more than once")),
        ("x,y\n1,2\n3\n", {"columns": {"a": "x"}}, ("a.csv:3", "2 values: x,y")),
        ('x,y\n1,"2\n', {"columns": {"a": "x"}}, ("a.csv:2", "is not CSV")),
        ("// x, y\n1,2\n", {"columns": {"a": "z"}}, ("a.csv:2", "no column 'z', it has x, y")),
        (
            "x,y\n1,2\n",
            {"columns": {"a": "x"}, "where": {"y": "3"}},
            ("a.csv", "no rows", "the key where requires"),
        ),
    ],
)
def test_wrong_tables(read, content, mapping, fragments):
    refusal(lambda: read(content, **mapping), *fragments)


COLUMNS = [
    pytest.param(column, id=f"{table.name}.{column.name}")
    for table in (*all_tables(), POSES, POINTS)
    for column in table.columns
]


@pytest.mark.parametrize("column", COLUMNS)
def test_the_first_unit_is_that_of_the_bounds(column):
    assert next(iter(column.units.values()), 1.0) == 1.0
    assert column.low < column.high
    assert column.doc


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_only_what_may_lack_may_be_no_number(value):
    with pytest.raises(InputError):
        VELOCITIES["w"].require("a.csv", [2], np.array((value,)))
    bearing = BEARING_RANGE["bearing"]
    if math.isnan(value):
        bearing.require("a.csv", [2], np.array((value,)))
    else:
        with pytest.raises(InputError, match=r"radians, not degrees, in -6.28319 to 6.28319, or nothing"):
            bearing.require("a.csv", [2], np.array((value,)))


def test_a_measured_range_is_above_zero():
    assert BEARING_RANGE["range"].measured.outside(np.array((0.0, 1e-300, 1e-3, 1e5, 2e5))).tolist() == [
        True,
        True,
        False,
        False,
        True,
    ]
