"""Sensor tables in a bag whose rows are messages or list elements, and RFID reads, by a mapping of fields."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.cells import NAMES, NUMBERS
from factorgraph_loc.files.column_mapping import ReadNames, in_case
from factorgraph_loc.files.columns import LATEST, STAMP, Column, Table
from factorgraph_loc.files.models import InUnit
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.io.bags.fields import LIST, Fields, TopicSettings, as_nanoseconds, as_number, as_text
from factorgraph_loc.io.bags.file import Bag, Stamped, TopicRows
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.sensors.rfid import tables as native_rfid
from factorgraph_loc.sensors.rfid.columns import RFID
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.tables import stream_of
from factorgraph_loc.text import listed
from factors.se2 import Array

ReadField = Literal["epc", "antenna", "rssi", "phase", "frequency", "stamp"]
READ = [RFID[name] for name in ("epc", "antenna", *native_rfid.SIGNALS)]
STAMP_OF_READ = replace(STAMP, name="stamp")


class TableTopic(TopicSettings):
    """A topic of rows of a table."""

    fields: dict[str, str] = Field(default_factory=dict)
    """path of each column of the table, by default a field with its name"""
    units: dict[str, str | float] = Field(default_factory=dict)
    """unit of each column, or a factor to ours"""


class RowsOfTopic:
    """Collects rows of a topic: ``columns`` of names and of numbers, by the ``fields`` of its messages; missing numbers are NaN.
    ``units``: names or factors by column."""

    def __init__(
        self,
        bag: Bag,
        topic: str,
        fields: Mapping[Any, str],
        columns: Sequence[Column],
        units: Mapping[Any, str | float],
    ) -> None:
        self._fields = Fields(bag, bag.topic(topic), fields)
        self._named = [column for column in columns if column.kind in NAMES]
        numbered = [column for column in columns if column.kind in NUMBERS]
        self._numbered = [column.name for column in numbered]
        source = f"{bag.path} {topic}"
        self._units = [column.in_unit(units.get(column.name, 1.0), source)[1] for column in numbered]
        self._names: dict[str, list[str]] = {column.name: [] for column in self._named}
        self._rows = TopicRows(source, len(numbered))

    def add(self, item: Stamped, t_ns: int) -> None:
        """Add the rows of a message."""
        for values in self._fields.rows(item.message, item.row):
            found = dict(zip(self._fields.names, values, strict=True))
            stamp = self._stamp(found, t_ns, item.row)
            for column in self._named:
                self._names[column.name].append(self._name(column, found, item.row))
            self._rows.append(item, stamp, tuple(as_number(found.get(name, math.nan)) for name in self._numbered))

    def _stamp(self, found: Mapping[Any, Any], t_ns: int, row: int) -> int:
        """The timestamp [ns] of a row with the values ``found`` by field, in a message that has ``t_ns``."""
        return t_ns

    def _name(self, column: Column, found: Mapping[Any, Any], row: int) -> str:
        """The name in ``column`` of a row with the values ``found`` by field; InputError if it is empty."""
        if text := as_text(found[column.name]):
            return text
        raise bad_field(self._rows.source, column.name, text, column.doc, row=row)

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


class RfidTopic(TopicSettings, ReadNames):
    """A topic of reads."""

    fields: dict[ReadField, str]
    """paths of the EPC, the antenna and other values in a message"""
    units: dict[Literal["rssi", "phase", "frequency", "stamp"], str | float] = Field(default_factory=dict)
    """units of rssi, phase, frequency and stamp, if not dBm, rad, Hz and us; or factors"""
    frames: dict[str, str] = Field(default_factory=dict)
    """frames of antennas in tf_static, if named differently"""
    rounds: Literal["gaps", "message"] = "gaps"
    """message if a message holds the reads of one inventory round, gaps if rounds are separated by round_gap"""
    round_gap: Annotated[float, Field(gt=0.0, le=10.0), InUnit("s")] = 0.05
    """gap between reads that ends an inventory round"""


class Reads(RowsOfTopic):
    """Collects the reads of a topic."""

    def __init__(self, bag: Bag, options: RfidTopic) -> None:
        self._options = options
        source = f"{bag.path} {options.topic}"
        if "epc" not in options.fields:
            raise InputError(f"{source}: fields.epc is missing")
        if ("antenna" in options.fields) == (options.antenna is not None):
            raise InputError(f"{source}: expected either fields.antenna, or antenna, the name of the only one")
        super().__init__(bag, options.topic, options.fields, READ, options.units)
        self._stamp_unit = round(STAMP_OF_READ.in_unit(options.units.get("stamp", "us"), source)[1])
        # the antenna of a message without reads
        self._listening = None
        if options.antenna is None and LIST not in options.fields["antenna"]:
            self._listening = Fields(bag, bag.topic(options.topic), {"antenna": options.fields["antenna"]})
        self._number: list[int] = []
        self._rounds: list[tuple[int, slice, str]] = []  # timestamp and reads of the message, antenna

    def add(self, item: Stamped, t_ns: int) -> None:
        """Add the reads of a message, and its rounds if it holds whole ones."""
        first = len(self._rows)
        super().add(item, t_ns)
        if self._options.rounds == "message":
            self._add_rounds(item, t_ns, slice(first, len(self._rows)))

    def _add_rounds(self, item: Stamped, t_ns: int, reads: slice) -> None:
        """Add the rounds of a message: one for each antenna in it, or one of its own antenna if it has no reads."""
        of_reads = self._names["antenna"][reads]
        antennas = list(dict.fromkeys(of_reads))
        if not antennas and self._options.antenna:
            antennas = [self._options.antenna]
        elif not antennas and self._listening is not None:
            found = {"antenna": self._listening.rows(item.message, item.row)[0][0]}
            antennas = [self._name(RFID["antenna"], found, item.row)]
        numbers = {name: len(self._rounds) + i for i, name in enumerate(antennas)}
        self._number += [numbers[name] for name in of_reads]
        self._rounds += [(t_ns, reads, name) for name in antennas]

    def stream(self, t0_ns: int, warnings: list[str]) -> RfidStream:
        """All reads in their rounds. InputError names the invalid message."""
        table = self.rows_of()
        table = replace(table, names=table.names | {"epc": in_case(table.names["epc"], self._options.epc_case)})
        native_rfid.check_reads(table)
        if self._options.rounds == "gaps":
            return native_rfid.read_rounds(table, None, self._options.round_gap, warnings).stream(t0_ns)
        ends = [max([t_ns, *table.t_ns[reads].tolist()]) for t_ns, reads, _ in self._rounds]
        number, end_ns = (np.array(column, dtype=np.int64) for column in (self._number, ends))
        signals = (table.numbers["rssi"], table.numbers["phase"], table.numbers["frequency"])
        antennas = [antenna for *_, antenna in self._rounds]
        reads = native_rfid.ReadsByRound(table.t_ns, number, table.names["epc"], signals, end_ns, antennas)
        return reads.stream(t0_ns)

    def _stamp(self, found: Mapping[Any, Any], t_ns: int, row: int) -> int:
        if "stamp" not in found:
            return t_ns
        try:
            stamp = as_nanoseconds(found["stamp"], self._stamp_unit)
            if abs(stamp) > LATEST:
                raise OverflowError
            return stamp
        except (ValueError, OverflowError):
            raise bad_field(self._rows.source, "stamp", found["stamp"], "a time, or a number", row=row) from None

    def _name(self, column: Column, found: Mapping[Any, Any], row: int) -> str:
        if column.name != "antenna":
            return super()._name(column, found, row)
        if self._options.antenna is not None:
            return self._options.antenna
        name = super()._name(column, found, row)
        return self._options.antennas.get(name, name)
