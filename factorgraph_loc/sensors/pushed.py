"""Validation of measurements pushed by a program; they are copied, so that the caller may reuse its arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from functools import cache
from typing import Any, TypeVar

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.columns import SECONDS, Table
from factorgraph_loc.files.values import names, numbers, seconds_of, within
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.plugins import load
from factorgraph_loc.sensors.registry import Channel, channels
from factorgraph_loc.sensors.tables import tables_of

M = TypeVar("M", bound=Measurement)


@cache
def kinds() -> Mapping[type[Any], Channel]:
    """The measurement classes, each with a channel that has it."""
    found: dict[type[Any], Channel] = {}
    for channel in channels().values():
        for place in channel.measurements:
            found.setdefault(load(place), channel)
    return found


def channel_of(kind: type[Any]) -> Channel:
    """The channel of a measurement's class; InputError if it is not one."""
    if kind not in kinds():
        known = ", ".join(one.__name__ for one in kinds())
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
    found = load(channel.check)(m, where) if channel.check else dict(_described(m, where, channel))
    copy: M = replace(m, t=t, **found)  # type: ignore[type-var]
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
    if table.rows_of_one_stamp == "one measurement" or any(c.kind != "number" or c.may_lack for c in columns):
        return None
    return ("t", SECONDS.low, SECONDS.high), *((c.name, c.low, c.high) for c in columns)


def _described(m: Measurement, where: str, channel: Channel) -> Iterator[tuple[str, Any]]:
    """The fields of a measurement that match the columns of a table: numbers, or names and arrays (K,) if it has several rows."""
    table = _table_of(type(m), channel)
    count: int | None = None
    for column in table.columns[1:]:
        if column.kind == "name":
            yield f"{column.name}s", (found := names(where, f"{column.name}s", getattr(m, f"{column.name}s")))
            count = len(found)
        else:
            value = getattr(m, column.measured.name)
            if count is None and table.rows_of_one_stamp == "one measurement":
                count = numbers(where, column.name, value).size
            yield column.measured.name, within(where, column, value, () if count is None else (count,))


@cache
def _table_of(kind: type[Any], channel: Channel) -> Table:
    there = {field.name for field in fields(kind)}
    return next(
        table
        for table in tables_of(channel)
        if all((f"{c.name}s" if c.kind == "name" else c.measured.name) in there for c in table.columns[1:])
    )
