"""Converts tables of files into streams and back, and validates pushed measurements, by the descriptions of their columns.

A channel whose stream has one field per column only needs a :class:`~factorgraph_loc.files.columns.Table`. Other
channels define the functions ``assemble`` and ``disassemble``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.columns import SECONDS, STAMP, Column, Table
from factorgraph_loc.files.several import is_name
from factorgraph_loc.files.values import names, numbers, seconds_of, within
from factorgraph_loc.model.measurement import Measurement, Stream
from factorgraph_loc.model.sections import several
from factorgraph_loc.plugins import load
from factorgraph_loc.sensors.registry import Channel, SensorType, channels, sensors
from factorgraph_loc.text import Notice, notice
from factors.se2 import Array, Integers

if TYPE_CHECKING:
    from factorgraph_loc.files.tables import TableRows
    from factorgraph_loc.model.rig import Rig

Columns = Mapping[str, Array | Integers | Sequence[str]]


@dataclass(frozen=True)
class Reading:
    """The context of a reader of rows. ``t0_ns``: the absolute time of t = 0 [ns]. ``warnings``:
    receives warnings. ``shared``: values that several sensors have in common by name, such as the origin of latitudes.
    """

    rig: Rig
    t0_ns: int
    warnings: list[Notice]
    shared: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Writing:
    """The context of a writer of one stream. ``log``: the name of its log. ``t0_ns``: the absolute time of t = 0
    [ns]. ``folder``: the folder of the tables."""

    log: str
    t0_ns: int
    folder: Path


@cache
def tables_of(channel: Channel) -> tuple[Table, ...]:
    """Return the descriptions of a channel's tables in a log. Several descriptions with the same name are alternatives."""
    return tuple(load(place) for place in channel.tables)


@cache
def native_tables() -> Mapping[str, tuple[Channel, tuple[Table, ...]]]:
    """Return the tables of the native format by name: the channel of each table, and its alternative descriptions."""
    return {
        table.name: (channel, tuple(candidate for candidate in tables_of(channel) if candidate.name == table.name))
        for channel in channels().values()
        for table in tables_of(channel)
    }


def native_table(name: str) -> tuple[str, tuple[Table, ...]] | None:
    """Return the channel name and the alternative descriptions of the table ``name`` of the native format. Returns None
    if there is no such table. The table of one of several sensors has a name such as ``bearing_range.front``."""
    kind, _, own = name.partition(".")
    if kind not in native_tables() or (kind != name and not (kind in several() and is_name(own))):
        return None
    channel, tables = native_tables()[kind]
    return name if kind != name else channel.name, tables


def all_tables(*chosen: SensorType) -> Iterator[Table]:
    """Yield the descriptions of the tables of the ``chosen`` sensors, by default of all sensors. For each sensor,
    tables of measurements come before tables of map layers."""
    for sensor in chosen or sensors().values():
        for channel in sensor.channels:
            yield from (load(place) for place in (*channel.tables, *channel.described))
        yield from (load(layer.table) for layer in sensor.layers.values() if layer.table)


def assemble(channel: Channel, rows: Mapping[str, TableRows], reading: Reading) -> Stream:
    """Return the stream of a channel from the ``rows`` of its tables, by table name. Raises InputError for invalid
    rows, and appends to ``reading.warnings`` for rows that are skipped."""
    if channel.assemble:
        made: Stream = load(channel.assemble)(rows, reading)
        return made
    ((name, only),) = rows.items()
    known = {STAMP.name, *only.numbers, *only.names}
    table = next(
        t for t in tables_of(channel) if t.name == name and all(column.name in known for column in t.in_file(known))
    )
    return stream_of(table, only, reading.t0_ns, reading.warnings)


def stream_of(table: Table, rows: TableRows, t0_ns: int, warnings: list[Notice]) -> Stream:
    """Return the stream of a table's rows. Of repeated rows the last one is kept. ``warnings``: receives warnings.

    Rows are repeated if they have the same timestamp. If the rows of one timestamp form one measurement, repeated rows
    also have the same name. Raises InputError with file, row and column for values out of bounds, decreasing
    timestamps, and rows without values.
    """
    values: dict[str, Any] = dict(rows.names)
    measured = [column for column in table.columns if column.name in rows.numbers]
    for column in measured:
        column.require(rows.path, rows.rows, rows.numbers[column.name])
    if measured and len(nothing := np.flatnonzero(_all_empty([rows.numbers[column.name] for column in measured]))):
        expected = ", ".join(f"a {column.name}" for column in measured) + " or both" * (len(measured) == 2)
        raise bad_field(rows.path, "row", "", expected, row=int(rows.rows[nothing[0]]))
    for column in measured:
        values[column.name] = _without_small(column, rows, warnings)
    if not table.is_scan:
        keep = checks.in_order(rows.path, rows.rows, rows.t_ns, warnings, rows.rules)
    else:
        names = next(iter(rows.names.values()), None) or [str(row) for row in rows.rows]
        keep = checks.last_in_order(rows.path, rows.rows, rows.t_ns, warnings, names, rows.rules)
        if measured:
            keep = keep[~_all_empty([values[column.name][keep] for column in measured])]
    kept = {
        column.field or column.name: values[column.name][keep]
        if isinstance(values[column.name], np.ndarray)
        else [values[column.name][i] for i in keep]
        for column in table.columns
        if column.name in values
    }
    made: Stream = load(table.stream)(t=checks.seconds(rows.t_ns[keep], t0_ns), **kept)
    return made


def _all_empty(columns: Sequence[Array]) -> NDArray[np.bool_]:
    """Return a mask (N,) that is True for rows without a number in any of the ``columns``, each (N,)."""
    return np.asarray(np.isnan(columns).all(axis=0))


def _without_small(column: Column, rows: TableRows, warnings: list[Notice]) -> Array:
    """Return the numbers (N,) of a column. Numbers below the column's ``left_out_below`` become NaN, with a warning."""
    values = rows.numbers[column.name]
    small = np.flatnonzero(values < column.left_out_below)
    if not len(small):
        return values
    sentence = "{source}:{row}: {column} is {value:g}: {rows} {column}s that are not above 0 are skipped"
    first, value = rows.rows[small[0]], values[small[0]]
    warnings.append(notice("not_positive", sentence, rows.path, first, column.name, value, len(small)))
    return np.where(values >= column.left_out_below, values, np.nan)


def disassemble(channel: Channel, stream: Stream, writing: Writing) -> dict[str, Columns]:
    """Return the columns of a stream's tables, by table name. Files that the stream refers to are copied into the
    folder. Raises InputError if the native format has no table for the stream."""
    if channel.disassemble:
        made: dict[str, Columns] = load(channel.disassemble)(stream, writing)
        return made
    for table in tables_of(channel):
        if table.stream and isinstance(stream, load(table.stream)):
            fields = {c.name: getattr(stream, c.field or c.name) for c in table.columns if c is not STAMP}
            return {table.name: {STAMP.name: checks.absolute(stream.t, writing.t0_ns), **fields}}
    raise InputError(f"{writing.log}: {channel.name} cannot be written: the native format has no table for it")


def columns_of(channel: Channel, stream: Stream) -> Iterator[Column]:
    """Yield the descriptions of a stream's numeric fields, each named as the field instead of the file's column."""
    for table in (*tables_of(channel), *(load(place) for place in channel.described)):
        if table.stream and load(table.stream) is type(stream):
            measured = [column.measured for column in table.columns if column.kind == "number"]
            yield from (column for column in measured if hasattr(stream, column.name))


M = TypeVar("M", bound=Measurement)


class Intake:
    """Processes the measurements of a channel that a program pushes one by one. The default accepts them unchanged."""

    def measured(self, m: Measurement) -> Measurement:
        """Return the measurement for the estimators, such as the features of an image. This may be called in any thread."""
        return m

    def require(self, m: Measurement) -> None:
        """Raise InputError if a measurement is inconsistent with the previous ones."""


@cache
def kinds() -> Mapping[type[Any], Channel]:
    """Return the channel of each class of measurements."""
    return {stream.kind: channel for channel in channels().values() for stream in channel.streams}


def channel_of(kind: type[Any]) -> Channel:
    """Return the channel of a class of measurements. Raises InputError if ``kind`` is no such class."""
    if kind not in kinds():
        known = ", ".join(each.__name__ for each in kinds())
        raise InputError(f"{kind.__name__} is not a measurement, expected one of {known}")
    return kinds()[kind]


def checked(m: M) -> M:
    """Return a validated copy of a measurement, or the measurement itself if it only consists of valid floats, which
    are immutable. Raises InputError with the first invalid field, its value and the expected values."""
    if (floats := _floats_of(type(m))) is not None:
        for name, low, high in floats:
            value = getattr(m, name)
            if type(value) is not float or not low <= value <= high:
                break
        else:
            return m
    channel = channel_of(type(m))
    t = seconds_of(type(m).__name__, m.t)
    where = f"{type(m).__name__} at {t:.3f} s"
    if not isinstance(m.source, str):
        raise bad_field(where, "source", m.source, "the name of a sensor")
    values = load(channel.check)(m, where) if channel.check else dict(_described(m, where, channel))
    copy: M = replace(m, t=t, **values)  # type: ignore[type-var]
    return copy


@cache
def _floats_of(kind: type[Measurement]) -> tuple[tuple[str, float, float], ...] | None:
    """Return name and inclusive bounds of each field of a class of measurements, such as those of odometry. Returns
    None if not all fields are single numbers. Raises InputError if ``kind`` is no class of measurements."""
    channel = channel_of(kind)
    if channel.check:
        return None
    table = _table_of(kind, channel)
    columns = [column.measured for column in table.columns[1:]]
    if table.is_scan or any(c.kind != "number" or c.may_lack for c in columns):
        return None
    return ("t", SECONDS.low, SECONDS.high), *((c.name, c.low, c.high) for c in columns)


def _described(m: Measurement, where: str, channel: Channel) -> Iterator[tuple[str, Any]]:
    """Yield name and validated value of each field of a measurement whose fields are the columns of a table of ``channel``.

    Values are numbers, or names and arrays (K,) if a measurement consists of K rows. ``where``: the measurement's name in errors.
    """
    table = _table_of(type(m), channel)
    count: int | None = None
    for column in table.columns[1:]:
        if column.kind == "name":
            yield f"{column.name}s", (values := names(where, f"{column.name}s", getattr(m, f"{column.name}s")))
            count = len(values)
        else:
            value = getattr(m, column.measured.name)
            if count is None and table.is_scan:
                count = numbers(where, column.name, value).size
            yield column.measured.name, within(where, column, value, () if count is None else (count,))


@cache
def _table_of(kind: type[Any], channel: Channel) -> Table:
    return next(table for table in tables_of(channel) if table.stream and load(table.stream).kind is kind)
