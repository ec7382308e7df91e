"""Reading of foreign tables by a mapping from their columns and units to fields.

CSV with any separator, with or without header, or JSON lines. The cells are read as text."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.cells import Cells, csv_rows, rows_of_length
from factorgraph_loc.files.models import FileModel, InUnit, inside, nearest, parse_json, read_text
from factorgraph_loc.text import listed, quoted, well_formed
from factors.se2 import Integers

JSON_SUFFIXES = (".jsonl", ".ndjson", ".json")
COMMENT = ("#", "//")

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


def read_mapped(
    path: Path,
    mapping: ColumnMapping,
    shapes: Sequence[Collection[str]],
    optional: Collection[str] = (),
    either: Collection[str] = (),
) -> Cells:
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
    if not len(found.rows):
        raise InputError(f"{path}: contains no rows{' as chosen by where' if mapping.where else ''}")
    return found


def _mapped(
    path: Path,
    rows: Integers,
    columns: Mapping[str, Sequence[str]],
    mapping: ColumnMapping,
    there: Iterable[str],
    *,
    unwanted: int,
    passed: int = 0,
) -> Cells:
    """The cells by field of the ``columns`` of a file, which has the columns ``there``."""
    fields = {field: columns[name] for field, name in mapping.columns.items() if name in columns}
    read = {*mapping.columns.values(), *mapping.where}
    left_out = tuple(name for name in there if name not in read)
    labels, units = mapping.columns, mapping.units
    return Cells(path, rows, fields, labels, units, mapping.decimal, left_out, passed, unwanted)


class TableFolder:
    """A folder of tables, with notes on what is not read of them.

    ``warnings``: lines about the content of the tables. Several mappings may read one file. What one of them reads is
    not left out.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[str] = []
        self._read: dict[Path, list[tuple[Cells, ColumnMapping]]] = {}

    def file(self, name: str) -> Path:
        """The path of a file in the folder; InputError if it lies elsewhere."""
        return inside(self.path, name, self.path)

    def read(self, mapping: ColumnMapping, shapes: Sequence[Collection[str]]) -> Cells:
        """Read the table of a mapping as :func:`read_mapped`, and note what is left out of it."""
        return self.noted(read_mapped(self.file(mapping.file), mapping, shapes), mapping)

    def noted(self, cells: Cells, mapping: ColumnMapping) -> Cells:
        """Note what the ``cells`` leave out of their file, and return them."""
        if cells.passed:
            self.warnings.append(f"{cells.path}: {cells.passed} objects that lack mapped columns are skipped")
        self._read.setdefault(cells.path, []).append((cells, mapping))
        return cells

    def left_out(self) -> list[str]:
        """A line for each file with rows that no mapping chooses, and one for all files with the same columns that are not read."""
        lines = []
        columns: dict[tuple[str, ...], list[str]] = {}
        for path, tables in self._read.items():
            read: set[int] = set()
            count = tables[0][0].unwanted + len(tables[0][0].rows)
            others = count if all(cells.unwanted for cells, _ in tables) else 0
            for rows in (cells.rows.tolist() for cells, _ in tables):
                others -= sum(row not in read for row in rows)  # a line of JSON may hold several
                read.update(rows)
            if others > 0:
                names = listed(dict.fromkeys(name for _, mapping in tables for name in mapping.where))
                lines.append(
                    f"{path.name}: {others} of {count + tables[0][0].passed} rows have another {names} than where says"
                )
            never = [set(cells.left_out) for cells, _ in tables]
            names_of = tuple(name for name in tables[0][0].left_out if all(name in unread for unread in never))
            columns.setdefault(names_of, []).append(path.name)
        for unread, (first, *more) in columns.items():
            if unread:
                files = f"{first} and {len(more)} more files" if more else first
                lines.append(f"{files}: columns that are not read: {listed(unread)}")
        return lines


def in_case(epcs: Sequence[str], case: EpcCase) -> list[str]:
    """EPCs in the letter case in which log and map are compared."""
    if case == "as written":
        return list(epcs)
    return [epc.upper() if case == "upper" else epc.lower() for epc in epcs]


def _read_csv(path: Path, mapping: ColumnMapping, needed: Sequence[Alternatives]) -> Cells:
    """The mapped cells of the chosen rows of a table."""
    numbered = [(row, line) for row, line in enumerate(read_text(path).splitlines(), start=1) if line.strip()]
    comments, content = _split_comments(numbered)
    if not content:
        raise InputError(f"{path}: contains no rows")
    parsed = _parsed(path, content, mapping.separator)
    body: Iterable[tuple[int, list[str]]]
    if mapping.header:
        first_row, first = next(parsed)
        named = next(_parsed(path, comments[-1:], mapping.separator), (0, []))[1]
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
    every = list(body)
    kept = [one for one in every if _is_chosen(one[1], chosen)]
    rows, columns = rows_of_length(path, header, kept)
    return _mapped(path, rows, columns, mapping, header, unwanted=len(every) - len(kept))


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


def _parsed(path: Path, lines: Sequence[tuple[int, str]], separator: str) -> Iterator[tuple[int, list[str]]]:
    if separator == " ":  # any number of blanks
        return ((row, line.split()) for row, line in lines)
    rows = csv_rows(path, lines, delimiter=separator, skipinitialspace=True)
    return ((row, [part.strip() for part in parts]) for row, parts in rows)


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


def _read_json_lines(path: Path, mapping: ColumnMapping, needed: Sequence[Alternatives]) -> Cells:
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
    found_columns = {column: values for column, values in columns.items() if column in seen}
    numbers = np.array(rows, dtype=np.int64)
    return _mapped(path, numbers, found_columns, mapping, there, unwanted=unwanted, passed=passed)


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
