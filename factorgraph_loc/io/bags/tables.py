"""Tables of sensors in a bag whose rows are messages, or parts of them, by a mapping of fields."""

from pathlib import Path

from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import Table
from factorgraph_loc.files.models import FileModel
from factorgraph_loc.files.tables import NAMES, TableRows
from factorgraph_loc.io.bags.clock import Clock
from factorgraph_loc.io.bags.fields import Fields, as_number, as_text
from factorgraph_loc.io.bags.file import Bag, Stamped
from factorgraph_loc.io.bags.rows import Rows
from factorgraph_loc.model.stream import Stream
from factorgraph_loc.sensors.tables import stream_of
from factorgraph_loc.text import listed


class TableTopic(FileModel):
    """``fields``: where a message has each column of the table, by default in fields of the same names. ``units``: by column, what
    to multiply with to have ours."""

    topic: str
    fields: dict[str, str] = Field(default_factory=dict)
    units: dict[str, float] = Field(default_factory=dict)
    clock: Clock | None = None


class RowsOfTopic:
    """Gathers the rows of a table."""

    def __init__(self, bag: Bag, options: TableTopic, table: Table) -> None:
        topic = bag.topic(options.topic)
        columns = {column.name: column for column in table.columns[1:]}
        fields = options.fields or {name: name for name in columns}
        needed = {name for name, column in columns.items() if not column.may_lack}
        if not needed <= set(fields) <= set(columns):
            raise InputError(f"{bag.path} {topic.name}: fields are {listed(fields)}, expected {listed(columns)}")
        self._table, self._fields, self._units = table, Fields(bag, topic, fields), options.units
        self._names: dict[str, list[str]] = {n: [] for n in fields if columns[n].kind in NAMES}
        self._numbers = [name for name in fields if name not in self._names]
        self._rows = Rows(f"{bag.path} {topic.name}", len(self._numbers))

    def add(self, item: Stamped, t_ns: int) -> None:
        for values in self._fields.rows(item.message, item.row):
            told = dict(zip(self._fields.names, values, strict=True))
            for name, texts in self._names.items():
                if not (text := as_text(told[name])):
                    raise bad_field(self._rows.source, name, text, self._table[name].doc, row=item.row)
                texts.append(text)
            numbers = (as_number(told[name]) * self._units.get(name, 1.0) for name in self._numbers)
            self._rows.append(item, t_ns, tuple(numbers))

    def stream(self, t0_ns: int, warnings: list[str]) -> Stream:
        """The rows as a stream; what is wrong with them is an InputError or a warning."""
        numbers = dict(zip(self._numbers, self._rows.values.T, strict=True))
        rows = TableRows(Path(self._rows.source), self._rows.rows, self._rows.t_ns, numbers, self._names)
        return stream_of(self._table, rows, t0_ns, warnings)
