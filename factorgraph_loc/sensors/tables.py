"""Converts tables of files into streams and back, and validates measurements, by the descriptions of their columns.

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
    """Arguments of ``Channel.assemble``. ``rig``: the robot and its sensors. ``t0_ns``: the absolute time of t = 0
    [ns]. ``warnings``: a list to append warnings to. ``shared``: values by name that several sensors use, such as the
    origin of latitudes and longitudes."""

    rig: Rig
    t0_ns: int
    warnings: list[Notice]
    shared: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Writing:
    """Arguments of ``Channel.disassemble``. ``log``: the name of the log. ``t0_ns``: the absolute time of t = 0
    [ns]. ``folder``: the folder of the files to write."""

    log: str
    t0_ns: int
    folder: Path


@cache
def tables_of(channel: Channel) -> tuple[Table, ...]:
    """Return the descriptions of a channel's files. Descriptions with the same name are alternative formats of a
    file."""
    return tuple(load(place) for place in channel.tables)


@cache
def native_tables() -> Mapping[str, tuple[Channel, tuple[Table, ...]]]:
    """Return the channel and the alternative formats of each table of the native format, by the name of the table."""
    return {
        table.name: (channel, tuple(candidate for candidate in tables_of(channel) if candidate.name == table.name))
        for channel in channels().values()
        for table in tables_of(channel)
    }


def native_table(name: str) -> tuple[str, tuple[Table, ...]] | None:
    """Return the name of the channel and the alternative formats of the table ``name`` of the native format. Returns
    None if there is no such table. If a rig has several sensors of a type, a table is named like
    "bearing_range.front"."""
    kind, _, own = name.partition(".")
    if kind not in native_tables() or (kind != name and not (kind in several() and is_name(own))):
        return None
    channel, tables = native_tables()[kind]
    return name if kind != name else channel.name, tables


def all_tables(*chosen: SensorType) -> Iterator[Table]:
    """Yield the descriptions of all tables of the sensors ``chosen``, by default of all sensors. The tables of
    measurements of a sensor come before the tables of its map layers."""
    for sensor in chosen or sensors().values():
        for channel in sensor.channels:
            yield from (load(place) for place in (*channel.tables, *channel.described))
        yield from (load(layer.table) for layer in sensor.layers.values() if layer.table)


def assemble(channel: Channel, rows: Mapping[str, TableRows], reading: Reading) -> Stream:
    """Return the stream of a channel. ``rows``: the rows of each table of the channel, by table name. Raises InputError
    for invalid rows. Warnings about skipped rows are appended to ``reading.warnings``."""
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
    """Return the rows of a table as a stream of measurements. ``t0_ns``: the absolute time of t = 0 [ns]. ``warnings``:
    a list to append warnings to.

    If several rows have the same timestamp, only the last one is kept. If a measurement consists of several rows with
    names, the last row of each name is kept. Raises InputError with file, row and column for values out of bounds,
    decreasing timestamps, and rows without values.
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
    """Return a mask (N,) that is True for rows with NaN in all ``columns`` (each (N,))."""
    return np.asarray(np.isnan(columns).all(axis=0))


def _without_small(column: Column, rows: TableRows, warnings: list[Notice]) -> Array:
    """Return the numbers (N,) of a column. Numbers below ``column.left_out_below`` become NaN. A warning about them is
    appended to ``warnings``."""
    values = rows.numbers[column.name]
    small = np.flatnonzero(values < column.left_out_below)
    if not len(small):
        return values
    sentence = "{source}:{row}: {column} is {value:g}: {rows} {column}s that are not above 0 are skipped"
    first, value = rows.rows[small[0]], values[small[0]]
    warnings.append(notice("not_positive", sentence, rows.path, first, column.name, value, len(small)))
    return np.where(values >= column.left_out_below, values, np.nan)


def disassemble(channel: Channel, stream: Stream, writing: Writing) -> dict[str, Columns]:
    """Return the columns of the files that store ``stream``, by table name. Images of the stream are copied into
    ``writing.folder``. Raises InputError if the native format has no table for the stream."""
    if channel.disassemble:
        made: dict[str, Columns] = load(channel.disassemble)(stream, writing)
        return made
    for table in tables_of(channel):
        if table.stream and isinstance(stream, load(table.stream)):
            fields = {c.name: getattr(stream, c.field or c.name) for c in table.columns if c is not STAMP}
            return {table.name: {STAMP.name: checks.absolute(stream.t, writing.t0_ns), **fields}}
    raise InputError(f"{writing.log}: {channel.name} cannot be written: the native format has no table for it")


def columns_of(channel: Channel, stream: Stream) -> Iterator[Column]:
    """Yield the description of each numeric field of ``stream``. The attribute ``name`` of a description is the name of
    the field."""
    for table in (*tables_of(channel), *(load(place) for place in channel.described)):
        if table.stream and load(table.stream) is type(stream):
            measured = [column.measured for column in table.columns if column.kind == "number"]
            yield from (column for column in measured if hasattr(stream, column.name))


M = TypeVar("M", bound=Measurement)


class Intake:
    """Checks and converts each measurement that a program passes to the live localizer. This base class accepts all
    measurements without changes."""

    def measured(self, m: Measurement) -> Measurement:
        """Return ``m`` in the form that estimators need, such as the features of an image. Thread-safe."""
        return m

    def require(self, m: Measurement) -> None:
        """Raise InputError if the measurement ``m`` is inconsistent with earlier measurements."""


@cache
def kinds() -> Mapping[type[Any], Channel]:
    """Return the channel of each class of measurements."""
    return {stream.kind: channel for channel in channels().values() for stream in channel.streams}


def channel_of(kind: type[Any]) -> Channel:
    """Return the channel of the measurement class ``kind``. Raises InputError if ``kind`` is no measurement class."""
    if kind not in kinds():
        known = ", ".join(each.__name__ for each in kinds())
        raise InputError(f"{kind.__name__} is not a measurement, expected one of {known}")
    return kinds()[kind]


def checked(m: M) -> M:
    """Return ``m`` if all its fields are valid floats, otherwise a copy of ``m`` with validated fields. Raises
    InputError with the name and value of the first invalid field."""
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
    """Return the name, the minimum and the maximum of each field of the measurement class ``kind``. Returns None if a
    field is not a single number. Raises InputError if ``kind`` is not a measurement class."""
    channel = channel_of(kind)
    if channel.check:
        return None
    table = _table_of(kind, channel)
    columns = [column.measured for column in table.columns[1:]]
    if table.is_scan or any(c.kind != "number" or c.may_lack for c in columns):
        return None
    return ("t", SECONDS.low, SECONDS.high), *((c.name, c.low, c.high) for c in columns)


def _described(m: Measurement, where: str, channel: Channel) -> Iterator[tuple[str, Any]]:
    """Yield the name and the validated value of each field of a measurement. The fields are columns of a table.

    A value is a number, or a list of names or an array (K,) if a measurement consists of K rows. ``where``: the name of
    the measurement in error messages. ``channel``: the channel of the measurement.
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
