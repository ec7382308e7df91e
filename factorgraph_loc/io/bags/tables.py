"""Sensor tables in a bag whose rows are messages or list elements, by a mapping of fields."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import Column, Table
from factorgraph_loc.files.models import FileModel
from factorgraph_loc.files.tables import NAMES, NUMBERS, TableRows
from factorgraph_loc.io.bags.clock import Clock
from factorgraph_loc.io.bags.fields import Fields, as_number, as_text
from factorgraph_loc.io.bags.file import Bag, Stamped
from factorgraph_loc.io.bags.rows import TopicRows
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.sensors.tables import stream_of
from factorgraph_loc.text import listed
from factors.se2 import Array


class TableTopic(FileModel):
    """A topic of rows of a table."""

    topic: str
    """name of the topic"""
    fields: dict[str, str] = Field(default_factory=dict)
    """path of each column of the table, by default a field with its name"""
    units: dict[str, float] = Field(default_factory=dict)
    """factors to our units, by column"""
    clock: Clock | None = None
    """timestamps of message headers or of receipt; by default as for the bag"""


class RowsOfTopic:
    """Collects rows of a topic: ``columns`` of names and of numbers, by the ``fields`` of its messages; missing numbers are NaN.
    ``units``: factors by column."""

    def __init__(
        self, bag: Bag, topic: str, fields: Mapping[Any, str], columns: Sequence[Column], units: Mapping[str, float]
    ) -> None:
        self._fields = Fields(bag, bag.topic(topic), fields)
        self._named = [column for column in columns if column.kind in NAMES]
        self._numbered = [column.name for column in columns if column.kind in NUMBERS]
        self._units = [units.get(name, 1.0) for name in self._numbered]
        self._names: dict[str, list[str]] = {column.name: [] for column in self._named}
        self._rows = TopicRows(f"{bag.path} {topic}", len(self._numbered))

    def add(self, item: Stamped, t_ns: int) -> None:
        """Add the rows of a message."""
        for values in self._fields.rows(item.message, item.row):
            told = dict(zip(self._fields.names, values, strict=True))
            for column in self._named:
                if not (text := as_text(told[column.name])):
                    raise bad_field(self._rows.source, column.name, text, column.doc, row=item.row)
                self._names[column.name].append(text)
            self._rows.append(item, t_ns, tuple(as_number(told.get(name, math.nan)) for name in self._numbered))

    def rows_of(self, numbers: Mapping[str, Array] | None = None) -> TableRows:
        """The collected rows, or the rows with other ``numbers`` (N,) computed from them."""
        if numbers is None:
            numbers = dict(zip(self._numbered, (self._rows.values * self._units).T, strict=True))
        return TableRows(Path(self._rows.source), self._rows.rows, self._rows.t_ns, dict(numbers), self._names)


class DescribedRows(RowsOfTopic):
    """Collects the rows of a table that needs only its description."""

    def __init__(self, bag: Bag, options: TableTopic, table: Table) -> None:
        columns = {column.name: column for column in table.columns[1:]}
        fields = options.fields or {name: name for name in columns}
        needed = {name for name, column in columns.items() if not column.may_lack}
        if not needed <= set(fields) <= set(columns):
            raise InputError(f"{bag.path} {options.topic}: fields are {listed(fields)}, expected {listed(columns)}")
        super().__init__(bag, options.topic, fields, table.columns[1:], options.units)
        self._table = table

    def stream(self, t0_ns: int, warnings: list[str]) -> Stream:
        """The rows as a stream; problems are an InputError or a warning."""
        return stream_of(self._table, self.rows_of(), t0_ns, warnings)
