"""Reading of foreign tables by a mapping from their columns and units to fields.

CSV with any separator, with or without header, or JSON lines. The cells are read as text."""

import csv
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import LATEST, Column, require_span
from factorgraph_loc.files.models import FileModel, InUnit, nearest, parse_json, read_text
from factorgraph_loc.files.tables import Cells
from factorgraph_loc.text import listed, quoted, told, well_formed
from factors.se2 import Array

JSON_SUFFIXES = (".jsonl", ".ndjson", ".json")
COMMENT = ("#", "//")
SECONDS = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # powers of ten of a nanosecond
ISO = "iso"
MOST_DIGITS = 20  # of a timestamp before its decimal point

EpcCase = Literal["as written", "upper", "lower"]
Alternatives = tuple[str, ...]  # columns of which one must be there
Value = bool | int | str
T = TypeVar("T")


class ReadNames(FileModel):
    """The names in a table or topic of RFID reads."""

    antenna: str | None = None
    """name of the only antenna, if the reads do not name it"""
    antennas: dict[str, str] = Field(default_factory=dict)
    """names in the rig of those of the reads"""
    epc_case: EpcCase = "as written"
    """letter case in which EPCs are compared with the map"""


class ColumnMapping(FileModel):
    """A table of another program."""

    file: str
    """file of the table, relative to the path of the manifest"""
    columns: dict[str, str]
    """column of the file for each field; in JSON lines a path of keys, such as event.epc; without header the number from
    1"""
    units: dict[str, str | float] = Field(default_factory=dict)
    """unit of each field, or a factor to ours"""
    separator: Literal[",", ";", "\t", " "] = ","
    """separator of the columns"""
    decimal: Literal[".", ","] = "."
    """decimal mark"""
    header: bool = True
    """whether the first row has the names of the columns"""
    where: dict[str, Value | tuple[Value, ...]] = Field(default_factory=dict)
    """value, or possible values, that columns of the file have in the rows to read"""

    def chosen(self) -> dict[str, set[str]]:
        """The values of ``where`` as the text of cells."""
        return {
            column: {_text(value) for value in (values if isinstance(values, tuple) else (values,))}
            for column, values in self.where.items()
        }


class TimedMapping(ColumnMapping):
    """A table of another program with timestamps."""

    clock_offset: Annotated[float, Field(ge=-1e10, le=1e10), InUnit("s")] = 0.0
    """added to all timestamps"""


@dataclass(frozen=True)
class Mapped:
    """N rows of a file by ``fields``; ``passed``: number of skipped JSON objects, which have none of the fields; ``left_out``:
    columns of the file that are not mapped; ``unwanted``: number of other rows than those of ``where``."""

    cells: Cells
    mapping: ColumnMapping
    fields: tuple[str, ...]
    passed: int = 0
    left_out: tuple[str, ...] = ()
    unwanted: int = 0

    @property
    def path(self) -> Path:
        return self.cells.path

    @property
    def rows(self) -> NDArray[np.int64]:
        """Line numbers (N,) of the rows in the file."""
        return np.array(self.cells.rows, dtype=np.int64)

    def texts(self, field: str) -> Sequence[str]:
        """The cells (N) of a field as text."""
        return self.cells.columns[self.mapping.columns[field]]

    def names(self, column: Column) -> list[str]:
        """The names (N) in the field that ``column`` describes; InputError if one is missing."""
        return self.cells.names(self.mapping.columns[column.name], column)

    def invalid(self, field: str, i: int, expected: str) -> InputError:
        """The error for cell ``i`` of a field."""
        column = self.mapping.columns[field]
        return bad_field(self.path, column, self.texts(field)[i], expected, row=self.cells.rows[i])

    def numbers(self, field: str, column: Column) -> Array:
        """The numbers (N,) in the field that ``column`` describes, in its unit; NaN if empty."""
        name = self.mapping.columns[field]
        cells = self.cells
        if self.mapping.decimal == ",":
            plain = [text.replace(",", ".") for text in cells.columns[name]]
            cells = Cells(cells.path, cells.rows, {name: plain})
        return cells.numbers(name, column, self.mapping.units.get(field, 1.0))

    def stamps(self, field: str, offset: float = 0.0) -> NDArray[np.int64]:
        """The timestamps (N,) of a field in nanoseconds, plus ``offset`` [s]. Times without a zone are UTC."""
        unit = self.mapping.units.get(field)
        if unit not in {*SECONDS, ISO}:
            expected = f"one of {', '.join(SECONDS)} or {ISO}"
            raise InputError(f"{self.path}: the unit of {field} is {quoted(unit)}, expected {expected}: units.{field}")
        shift = round(offset * 1e9)
        out = np.empty(len(self.cells.rows), dtype=np.int64)
        for i, text in enumerate(self.texts(field)):
            try:
                stamp = iso_nanoseconds(text) if unit == ISO else self._decimal(text, SECONDS[str(unit)])
                if abs(stamp + shift) > LATEST:
                    raise OverflowError
            except (ValueError, ArithmeticError):
                most = LATEST / 10 ** SECONDS.get(str(unit), 0)
                expected = f"a number of {unit} in {-most:g} to {most:g}"
                if unit == ISO:
                    expected = "a date and time, 2026-01-31T12:00:00.5Z"
                raise self.invalid(field, i, expected) from None
            out[i] = stamp + shift
        require_span([(self.path, self.cells.rows, out)])
        return out

    def _decimal(self, text: str, power: int) -> int:
        """A decimal number times ten to the ``power``, rounded, without floating-point errors."""
        number = Decimal(text.replace(self.mapping.decimal, "."))
        if not number.is_finite() or number.adjusted() > MOST_DIGITS:  # checked before the digits are expanded
            raise OverflowError
        return round(number.scaleb(power))


def read_mapped(
    path: Path,
    mapping: ColumnMapping,
    shapes: Sequence[Collection[str]],
    optional: Collection[str] = (),
    either: Collection[str] = (),
) -> Mapped:
    """Read the rows of a file whose mapped fields are those of one of ``shapes``, and perhaps some of ``optional``.

    The column of an optional field may be missing, but not those of all mapped fields of ``either``. InputError names file, row and
    column of invalid values.
    """
    given = set(mapping.columns)
    known = set(optional).union(*shapes)
    if unknown := sorted(given - known):
        raise InputError(f"{path}: there is no field {quoted(unknown[0])} to map{nearest(unknown[0], sorted(known))}")
    if not any(set(shape) <= given <= set(shape).union(optional) for shape in shapes):
        expected = " or ".join(", ".join(shape) for shape in shapes)
        raise InputError(f"{path}: columns maps {listed(sorted(given)) or 'nothing'}, expected {expected}")
    if stray := sorted(set(mapping.units) - given):
        raise InputError(f"{path}: units.{stray[0]} belongs to no field of columns")
    needed: list[Alternatives] = [
        (column,) for field, column in mapping.columns.items() if field not in (*optional, *either)
    ]
    if either:
        needed.append(tuple(mapping.columns[field] for field in either if field in given))
    read = _read_json_lines if path.suffix.lower() in JSON_SUFFIXES else _read_csv
    found = read(path, mapping, needed)
    if not found.cells.rows:
        raise InputError(f"{path}: contains no rows{' as chosen by where' if mapping.where else ''}")
    return found


def _mapped(cells: Cells, mapping: ColumnMapping, there: Iterable[str], unwanted: int, passed: int = 0) -> Mapped:
    """The ``cells`` of a file with the columns ``there`` by fields."""
    fields = tuple(field for field, column in mapping.columns.items() if column in cells.columns)
    left_out = tuple(name for name in there if name not in cells.columns and name not in mapping.where)
    return Mapped(cells, mapping, fields, passed, left_out, unwanted)


def in_case(epcs: Sequence[str], case: EpcCase) -> list[str]:
    """EPCs in the letter case in which log and map are compared."""
    if case == "as written":
        return list(epcs)
    return [epc.upper() if case == "upper" else epc.lower() for epc in epcs]


def iso_nanoseconds(text: str) -> int:
    """An ISO 8601 date and time as nanoseconds since 1970; without a zone it is UTC. ValueError if the text is invalid."""
    # datetime has microseconds only
    fraction = re.search(r"[.,](\d+)", text)
    whole = text.replace(fraction.group(0), "", 1) if fraction else text
    moment = datetime.fromisoformat(whole.strip())
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    digits = fraction.group(1) if fraction else ""
    return int(moment.timestamp()) * 10**9 + int((digits + "0" * 9)[:9])


def _read_csv(path: Path, mapping: ColumnMapping, needed: Sequence[Alternatives]) -> Mapped:
    """The mapped cells of the chosen rows of a table."""
    numbered = [(row, line) for row, line in enumerate(read_text(path).splitlines(), start=1) if line.strip()]
    comments, content = _split_comments(numbered)
    if not content:
        raise InputError(f"{path}: contains no rows")
    parsed = _cells_of(path, content, mapping.separator)
    body: Iterable[tuple[int, list[str]]]
    if mapping.header:
        first_row, first = next(parsed)
        named = next(_cells_of(path, comments[-1:], mapping.separator), (0, []))[1]
        # a comment with as many names as there are columns is the header, unless the first row contains the names
        in_comment = _has(named, needed) or (len(named) == len(first) and not _has(first, needed))
        header = named if in_comment else first
        body = chain([(first_row, first)], parsed) if in_comment else parsed
    else:
        body = list(parsed)
        # rows of other kinds may have other numbers of columns
        chosen = _places(_numbers(max(len(parts) for _, parts in body)), mapping.chosen())
        first_row, first = next((one for one in body if _is_chosen(one[1], chosen)), body[0])
        header = _numbers(len(first))
    _require_columns(path, mapping, needed, header, first_row)
    chosen = _places(header, mapping.chosen())
    rows, table, unwanted = [], [], 0
    for row, parts in body:
        if not _is_chosen(parts, chosen):
            unwanted += 1
            continue
        if len(parts) != len(header):
            raise bad_field(path, "row", ",".join(parts), f"{len(header)} values: {','.join(header)}", row=row)
        rows.append(row)
        table.append(parts)
    places = _places(header, dict.fromkeys(mapping.columns.values()))
    columns = {header[i]: [parts[i] for parts in table] for i in places}
    return _mapped(Cells(path, rows, columns), mapping, header, unwanted)


def _numbers(count: int) -> list[str]:
    """The names of ``count`` columns without header."""
    return [str(i) for i in range(1, count + 1)]


def _places(header: Sequence[str], columns: Mapping[str, T]) -> dict[int, T]:
    """The values of ``columns``, by the index of the column in the header; others are left out."""
    at = {column: i for i, column in enumerate(header)}
    return {at[column]: value for column, value in columns.items() if column in at}


def _is_chosen(parts: Sequence[str], chosen: Mapping[int, set[str]]) -> bool:
    return all(i < len(parts) and parts[i] in values for i, values in chosen.items())


def _split_comments(lines: Sequence[tuple[int, str]]) -> tuple[list[tuple[int, str]], list[tuple[int, str]]]:
    """Split off the comments before the first row, without their marks; the last one may be the header."""
    content = [(row, line) for row, line in lines if not line.lstrip().startswith(COMMENT)]
    until = content[0][0] if content else 0
    comments = [(row, line.lstrip().lstrip("#/").strip()) for row, line in lines if row < until]
    return comments, content


def _cells_of(path: Path, lines: Sequence[tuple[int, str]], separator: str) -> Iterator[tuple[int, list[str]]]:
    if separator == " ":  # any number of blanks
        yield from ((row, line.split()) for row, line in lines)
        return
    reader = csv.reader((line for _, line in lines), delimiter=separator, skipinitialspace=True, strict=True)
    try:
        for parts in reader:
            yield lines[reader.line_num - 1][0], [part.strip() for part in parts]
    except csv.Error as error:
        raise InputError(f"{path}:{lines[reader.line_num - 1][0]}: is not CSV: {told(error)}") from error


def _has(names: Collection[str], needed: Sequence[Alternatives]) -> bool:
    return all(any(column in names for column in columns) for columns in needed)


def _require_columns(
    path: Path, mapping: ColumnMapping, needed: Sequence[Alternatives], header: Sequence[str], row: int
) -> None:
    """InputError if a needed column is missing, or a mapped one is there twice."""
    counts = Counter(header)
    for columns in [*needed, *((column,) for column in mapping.where)]:
        if not _has(counts, [columns]):
            raise InputError(f"{path}:{row}: has no column {quoted(columns[0])}, it has {listed(header)}")
    for column in (*mapping.columns.values(), *mapping.where):
        if counts[column] > 1:
            raise InputError(f"{path}:{row}: has the column {quoted(column)} more than once")


def _read_json_lines(path: Path, mapping: ColumnMapping, needed: Sequence[Alternatives]) -> Mapped:
    """The mapped cells of the chosen objects of JSON lines (one object or a list of them per line) that have all ``needed``
    columns."""
    rows: list[int] = []
    columns: dict[str, list[str]] = {column: [] for column in mapping.columns.values()}
    chosen = mapping.chosen()
    passed, unwanted = 0, 0
    seen: set[str] = set()
    keys: list[str] = []
    there: dict[str, None] = {}
    for row, entry in _objects(path):
        if any(_text(_at(entry, column)) not in values for column, values in chosen.items()):
            unwanted += 1
            continue
        found = {column: _at(entry, column) for column in columns}
        known = {column for column, value in found.items() if value is not None}
        keys = keys or sorted(_paths(entry))
        seen |= known
        if not _has(known, needed):
            passed += 1
            continue
        rows.append(row)
        there |= dict.fromkeys(_paths(entry))
        for column, value in found.items():
            if isinstance(value, (dict, list)):
                raise bad_field(path, column, value, "a number or a text", row=row)
            columns[column].append(_text(value))
    for alternatives in needed:
        if passed and not seen.intersection(alternatives):
            raise InputError(f"{path}: no object has {quoted(alternatives[0])}, the first has {listed(keys)}")
    cells = Cells(path, rows, {column: values for column, values in columns.items() if column in seen})
    return _mapped(cells, mapping, there, unwanted, passed)


def _text(value: Any) -> str:
    """A value of JSON or TOML as the text of a cell."""
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else well_formed(str(value))


def _objects(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """The objects of JSON lines with their line numbers."""
    for row, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        content = parse_json(line, f"{path}:{row}")
        entries = content if isinstance(content, list) else [content]
        if not all(isinstance(entry, dict) for entry in entries):
            raise bad_field(path, "line", line.strip()[:80], "an object, or a list of objects", row=row)
        yield from ((row, entry) for entry in entries)


def _at(entry: Mapping[str, Any], keys: str) -> Any:
    """The value at a path of keys joined by dots, or None."""
    value: Any = entry
    for key in keys.split("."):
        if not isinstance(value, Mapping) or key not in value:
            return None
        value = value[key]
    return value


def _paths(entry: Mapping[str, Any], before: str = "") -> Iterator[str]:
    for key, value in entry.items():
        if isinstance(value, Mapping):
            yield from _paths(value, f"{before}{key}.")
        else:
            yield before + key
