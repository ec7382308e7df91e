"""Sensor tables in a bag whose rows are messages or list elements, and RFID reads, by a mapping of fields."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.column_mapping import SECONDS, EpcCase, in_case
from factorgraph_loc.files.columns import LATEST, Column, Table
from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.files.tables import NAMES, NUMBERS, TableRows
from factorgraph_loc.io.bags.fields import LIST, Clock, Fields, as_nanoseconds, as_number, as_text
from factorgraph_loc.io.bags.file import Bag, Stamped, TopicRows
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.sensors.rfid import tables as native_rfid
from factorgraph_loc.sensors.rfid.columns import RFID
from factorgraph_loc.sensors.tables import stream_of
from factorgraph_loc.text import listed
from factors.se2 import Array

ReadField = Literal["epc", "antenna", "rssi", "phase", "frequency", "stamp"]
SIGNALS = {name: RFID[name].units for name in ("rssi", "phase", "frequency")}


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


class RfidTopic(FileModel):
    """A topic of reads."""

    topic: str
    """name of the topic"""
    fields: dict[ReadField, str]
    """paths of the EPC, the antenna and other values in a message"""
    units: dict[Literal["rssi", "phase", "frequency", "stamp"], str | float] = Field(default_factory=dict)
    """units of rssi, phase, frequency and stamp, if not dBm, rad, Hz and us; or factors"""
    antenna: str | None = None
    """name of the only antenna, if messages do not name it"""
    antennas: dict[str, str] = Field(default_factory=dict)
    """names in the rig of those in messages"""
    epc_case: EpcCase = "as written"
    """letter case in which EPCs are compared with the map"""
    frames: dict[str, str] = Field(default_factory=dict)
    """frames of antennas in tf_static, if named differently"""
    rounds: Literal["gaps", "message"] = "gaps"
    """message if a message holds the reads of one inventory round, gaps if rounds are separated by round_gap"""
    round_gap: Annotated[float, Field(gt=0.0, le=10.0), InUnit("s")] = 0.05
    """gap between reads that ends an inventory round"""
    clock: Clock | None = None
    """timestamps of message headers or of receipt; by default as for the bag"""


class Reads:
    """Collects the reads of a topic."""

    def __init__(self, bag: Bag, options: RfidTopic) -> None:
        self._options = options
        self._source = f"{bag.path} {options.topic}"
        if "epc" not in options.fields:
            raise InputError(f"{self._source}: fields.epc is missing")
        if ("antenna" in options.fields) == (options.antenna is not None):
            raise InputError(f"{self._source}: expected either fields.antenna, or antenna, the name of the only one")
        topic = bag.topic(options.topic)
        self._scale = np.array([self._factor(name, units) for name, units in SIGNALS.items()])
        self._stamp_unit = round(self._factor("stamp", {"us": 1e3} | {k: 10.0**n for k, n in SECONDS.items()}))
        self._fields = Fields(bag, topic, options.fields)
        # the antenna of a message without reads
        self._listening = None
        if options.antenna is None and LIST not in options.fields["antenna"]:
            self._listening = Fields(bag, topic, {"antenna": options.fields["antenna"]})
        self._rows: list[int] = []
        self._t_ns: list[int] = []
        self._epc: list[str] = []
        self._antenna: list[str] = []
        self._signals: list[tuple[float, ...]] = []
        self._number: list[int] = []
        self._end_ns: list[int] = []
        self._round_antenna: list[str] = []

    def add(self, item: Stamped, t_ns: int) -> None:
        first = len(self._rows)
        for values in self._fields.rows(item.message, item.row):
            told = dict(zip(self._fields.names, values, strict=True))
            self._rows.append(item.row)
            self._t_ns.append(self._stamp(told["stamp"], item.row) if "stamp" in told else t_ns)
            self._epc.append(self._name("epc", told["epc"], item.row))
            self._antenna.append(self._options.antenna or self._antenna_of(told["antenna"], item.row))
            self._signals.append(tuple(as_number(told[name]) if name in told else np.nan for name in SIGNALS))
        if self._options.rounds == "message":
            self._end_rounds(item, t_ns, first)

    def _end_rounds(self, item: Stamped, t_ns: int, first: int) -> None:
        """Add the rounds of a message: one for each antenna in it, or one of its own antenna if it has no reads."""
        antennas = list(dict.fromkeys(self._antenna[first:]))
        if not antennas and self._options.antenna:
            antennas = [self._options.antenna]
        elif not antennas and self._listening is not None:
            antennas = [self._antenna_of(self._listening.rows(item.message, item.row)[0][0], item.row)]
        numbers = {name: len(self._end_ns) + i for i, name in enumerate(antennas)}
        self._number += [numbers[name] for name in self._antenna[first:]]
        self._end_ns += [max([t_ns, *self._t_ns[first:]])] * len(antennas)
        self._round_antenna += antennas

    def rounds(self, warnings: list[str]) -> native_rfid.ReadsByRound:
        """All reads in their rounds. InputError names the invalid message."""
        table = self._table()
        native_rfid.check_reads(table)
        if self._options.rounds == "gaps":
            return native_rfid.read_rounds(table, None, self._options.round_gap, warnings)
        signals = (table.numbers["rssi"], table.numbers["phase"], table.numbers["frequency"])
        number, end_ns = (np.array(column, dtype=np.int64) for column in (self._number, self._end_ns))
        return native_rfid.ReadsByRound(table.t_ns, number, table.names["epc"], signals, end_ns, self._round_antenna)

    def _table(self) -> TableRows:
        signals = np.array(self._signals, dtype=float).reshape(-1, len(SIGNALS))
        return TableRows(
            path=Path(self._source),  # used in messages only
            rows=np.array(self._rows, dtype=np.int64),
            t_ns=np.array(self._t_ns, dtype=np.int64),
            numbers=dict(zip(SIGNALS, (signals * self._scale).T, strict=True)),
            names={"epc": in_case(self._epc, self._options.epc_case), "antenna": self._antenna},
        )

    def _stamp(self, value: Any, row: int) -> int:
        try:
            stamp = as_nanoseconds(value, self._stamp_unit)
            if abs(stamp) > LATEST:
                raise OverflowError
            return stamp
        except (ValueError, OverflowError):
            raise bad_field(self._source, "stamp", value, "a time, or a number", row=row) from None

    def _factor(self, field: Any, units: Mapping[str, float]) -> float:
        """The unit factor of a field, by default that of the first of ``units``."""
        unit = self._options.units.get(field, next(iter(units)))
        if not isinstance(unit, str):
            return float(unit)
        if unit not in units:
            raise bad_field(self._source, f"units.{field}", unit, f"one of {', '.join(units)}, or a number")
        return units[unit]

    def _antenna_of(self, value: Any, row: int) -> str:
        name = self._name("antenna", value, row)
        return self._options.antennas.get(name, name)

    def _name(self, field: ReadField, value: Any, row: int) -> str:
        text = as_text(value)
        if not text:
            raise bad_field(self._source, field, text, RFID[field].doc, row=row)
        return text
