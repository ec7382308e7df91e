"""Reads of RFID tags in a bag, from messages of any type by a mapping of fields."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import FileModel
from factorgraph_loc.readers import native_rfid
from factorgraph_loc.readers.bag_clock import Clock
from factorgraph_loc.readers.bag_fields import LIST, Fields, as_nanoseconds, as_number, as_text
from factorgraph_loc.readers.bag_file import Bag, Stamped
from factorgraph_loc.readers.tables import NAMES, Table

ReadField = Literal["epc", "antenna", "rssi", "phase", "frequency", "stamp"]
UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
FREQUENCY = {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6}
SIGNALS = ("rssi", "phase", "frequency")


class RfidTopic(FileModel):
    """``fields``: where a message has the EPC, the antenna, and what else it tells. ``antenna``: the name of the only antenna,
    where messages do not tell it. ``frames``: those of antennas in tf_static, where they are not their names. ``rounds``:
    ``message`` where each message holds the reads of one inventory round, none if it read nothing; ``gaps`` where rounds are
    found from pauses of ``round_gap`` seconds between reads."""

    topic: str
    fields: dict[ReadField, str]
    antenna: str | None = None
    frames: dict[str, str] = Field(default_factory=dict)
    rounds: Literal["gaps", "message"] = "gaps"
    round_gap: Annotated[float, Field(gt=0.0, le=10.0, description="s")] = 0.05
    phase_unit: Literal["rad", "deg"] = "rad"
    frequency_unit: Literal["Hz", "kHz", "MHz"] = "Hz"
    stamp_unit: Literal["s", "ms", "us", "ns"] = "us"
    clock: Clock | None = None


class Reads:
    """Gathers the reads of a topic."""

    def __init__(self, bag: Bag, options: RfidTopic) -> None:
        self._options = options
        self._source = f"{bag.path} {options.topic}"
        if "epc" not in options.fields:
            raise InputError(f"{self._source}: fields.epc is missing")
        if ("antenna" in options.fields) == (options.antenna is not None):
            raise InputError(f"{self._source}: expected either fields.antenna, or antenna, the name of the only one")
        topic = bag.topic(options.topic)
        self._fields = Fields(bag, topic, options.fields)
        # the antenna of a message that holds no reads
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
            self._antenna.append(self._options.antenna or self._name("antenna", told["antenna"], item.row))
            self._signals.append(tuple(as_number(told[name]) if name in told else np.nan for name in SIGNALS))
        if self._options.rounds == "message":
            self._end_rounds(item, t_ns, first)

    def _end_rounds(self, item: Stamped, t_ns: int, first: int) -> None:
        """The rounds that a message tells of: one of each antenna in it, and one of its own antenna if it holds no reads."""
        antennas = list(dict.fromkeys(self._antenna[first:]))
        if not antennas and self._options.antenna:
            antennas = [self._options.antenna]
        elif not antennas and self._listening is not None:
            antennas = [self._name("antenna", self._listening.rows(item.message, item.row)[0][0], item.row)]
        numbers = {name: len(self._end_ns) + i for i, name in enumerate(antennas)}
        self._number += [numbers[name] for name in self._antenna[first:]]
        self._end_ns += [max([t_ns, *self._t_ns[first:]])] * len(antennas)
        self._round_antenna += antennas

    def rounds(self, warnings: list[str]) -> native_rfid.Rounds:
        """All reads in their rounds. InputError names the message of what is wrong."""
        table = self._table()
        native_rfid.check_reads(table)
        if self._options.rounds == "gaps":
            return native_rfid.read_rounds(table, None, self._options.round_gap, warnings)
        signals = (table.numbers["rssi"], table.numbers["phase"], table.numbers["frequency"])
        number, end_ns = (np.array(column, dtype=np.int64) for column in (self._number, self._end_ns))
        return native_rfid.Rounds(table.t_ns, number, self._epc, signals, end_ns, self._round_antenna)

    def _table(self) -> Table:
        signals = np.array(self._signals, dtype=float).reshape(-1, len(SIGNALS))
        scale = np.array((1.0, np.pi / 180.0, 1.0)) if self._options.phase_unit == "deg" else np.ones(3)
        scale[2] = FREQUENCY[self._options.frequency_unit]
        return Table(
            path=Path(self._source),  # only named in messages
            rows=np.array(self._rows, dtype=np.int64),
            t_ns=np.array(self._t_ns, dtype=np.int64),
            numbers=dict(zip(SIGNALS, (signals * scale).T, strict=True)),
            names={"epc": self._epc, "antenna": self._antenna},
        )

    def _stamp(self, value: Any, row: int) -> int:
        try:
            return as_nanoseconds(value, UNITS[self._options.stamp_unit])
        except (ValueError, OverflowError):
            expected = f"a time, or a number of {self._options.stamp_unit}"
            raise bad_field(self._source, "stamp", value, expected, row=row) from None

    def _name(self, field: ReadField, value: Any, row: int) -> str:
        text = as_text(value)
        if not text:
            raise bad_field(self._source, field, text, NAMES[field], row=row)
        return text
