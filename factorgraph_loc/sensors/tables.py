"""Conversion between tables and streams by the descriptions of their columns.

A sensor whose stream fields are columns needs only a description, a :class:`~factorgraph_loc.files.columns.Table`; others define
``assemble`` and ``disassemble`` of their channels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
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
    """The context of reading rows: the ``rig``, the absolute time of t = 0, and the list of warnings."""

    rig: Rig
    t0_ns: int
    warnings: list[Notice]


@dataclass(frozen=True)
class Writing:
    """The context of writing a stream: the name of its log, the absolute time of t = 0, and the ``folder`` of the tables."""

    log: str
    t0_ns: int
    folder: Path


@cache
def tables_of(channel: Channel) -> tuple[Table, ...]:
    """The tables of a channel in a log; several of one name are alternatives."""
    return tuple(load(place) for place in channel.tables)


@cache
def native_tables() -> Mapping[str, tuple[Channel, tuple[Table, ...]]]:
    """The channel and the descriptions of each table of a log, by table name."""
    return {
        table.name: (channel, tuple(candidate for candidate in tables_of(channel) if candidate.name == table.name))
        for channel in channels().values()
        for table in tables_of(channel)
    }


def native_table(name: str) -> tuple[str, tuple[Table, ...]] | None:
    """The name of the channel with a table of a log, such as ``bearing_range.front`` of one of several sensors, and the
    descriptions of the table; None if there is none."""
    kind, _, own = name.partition(".")
    if kind not in native_tables() or (kind != name and not (kind in several() and is_name(own))):
        return None
    channel, tables = native_tables()[kind]
    return name if kind != name else channel.name, tables


def all_tables(*chosen: SensorType) -> Iterator[Table]:
    """The descriptions of the tables of sensors, by default of all: of the channels of each, then of its layers of the map."""
    for sensor in chosen or sensors().values():
        for channel in sensor.channels:
            yield from (load(place) for place in (*channel.tables, *channel.described))
        yield from (load(layer.table) for layer in sensor.layers.values() if layer.table)


def assemble(channel: Channel, rows: Mapping[str, TableRows], reading: Reading) -> Stream:
    """The stream of a channel from the ``rows`` of its tables; problems are an InputError or a warning."""
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
    """The stream of a table's rows.

    If the rows of one timestamp form a measurement, the last row of each name is kept, otherwise the last row of each timestamp.
    InputError names file, row and column of values out of bounds, decreasing timestamps, and rows without any value.
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
        keep = checks.in_order(rows.path, rows.rows, rows.t_ns, warnings)
    else:
        names = next(iter(rows.names.values()), None) or [str(row) for row in rows.rows]
        keep = checks.last_in_order(rows.path, rows.rows, rows.t_ns, warnings, names)
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
    """Whether each row (N,) has no number in any column."""
    return np.asarray(np.isnan(columns).all(axis=0))


def _without_small(column: Column, rows: TableRows, warnings: list[Notice]) -> Array:
    """The numbers (N,) of a column, with those below its ``left_out_below`` removed."""
    values = rows.numbers[column.name]
    small = np.flatnonzero(values < column.left_out_below)
    if not len(small):
        return values
    sentence = "{source}:{row}: {column} is {value:g}: {rows} {column}s that are not above 0 are skipped"
    first, value = rows.rows[small[0]], values[small[0]]
    warnings.append(notice("not_positive", sentence, rows.path, first, column.name, value, len(small)))
    return np.where(values >= column.left_out_below, values, np.nan)


def disassemble(channel: Channel, stream: Stream, writing: Writing) -> dict[str, Columns]:
    """The columns of a stream's tables by table name; referenced files are copied into the folder. InputError if a stream has no
    table."""
    if channel.disassemble:
        made: dict[str, Columns] = load(channel.disassemble)(stream, writing)
        return made
    for table in tables_of(channel):
        if table.stream and isinstance(stream, load(table.stream)):
            fields = {c.name: getattr(stream, c.field or c.name) for c in table.columns if c is not STAMP}
            return {table.name: {STAMP.name: checks.absolute(stream.t, writing.t0_ns), **fields}}
    raise InputError(f"{writing.log}: {channel.name} has no table in this format")


def columns_of(channel: Channel, stream: Stream) -> Iterator[Column]:
    """The columns that describe a stream's numbers, named by its fields."""
    for table in (*tables_of(channel), *(load(place) for place in channel.described)):
        if table.stream and load(table.stream) is type(stream):
            measured = [column.measured for column in table.columns if column.kind == "number"]
            yield from (column for column in measured if hasattr(stream, column.name))


M = TypeVar("M", bound=Measurement)


class Intake:
    """A channel's processing of measurements that a program pushes one by one."""

    def measured(self, m: Measurement) -> Measurement:
        """The measurement that estimators take, such as the features of an image. Called in any thread."""
        return m

    def require(self, m: Measurement) -> None:
        """InputError if a measurement does not fit the previous ones."""


@cache
def kinds() -> Mapping[type[Any], Channel]:
    """The measurement classes, each with its channel."""
    return {stream.kind: channel for channel in channels().values() for stream in channel.streams}


def channel_of(kind: type[Any]) -> Channel:
    """The channel of a measurement's class; InputError if it is not one."""
    if kind not in kinds():
        known = ", ".join(each.__name__ for each in kinds())
        raise InputError(f"{kind.__name__} is not a measurement, expected one of {known}")
    return kinds()[kind]


def checked(m: M) -> M:
    """A validated copy of a measurement, or itself if it consists of valid floats, which nobody can change; InputError names the
    first invalid field, its value and the expected values."""
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
    """Name and inclusive bounds of each field of a class with numbers only, as rows of odometry have; None for others.
    InputError if it is no class of measurements."""
    channel = channel_of(kind)
    if channel.check:
        return None
    table = _table_of(kind, channel)
    columns = [column.measured for column in table.columns[1:]]
    if table.is_scan or any(c.kind != "number" or c.may_lack for c in columns):
        return None
    return ("t", SECONDS.low, SECONDS.high), *((c.name, c.low, c.high) for c in columns)


def _described(m: Measurement, where: str, channel: Channel) -> Iterator[tuple[str, Any]]:
    """The fields of a measurement that match the columns of a table: numbers, or names and arrays (K,) if it has several rows."""
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
