"""Reading of foreign tables by a mapping from their columns and units to fields.

CSV with any separator, with or without header, or JSON lines. The cells are read as text."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.checks import unread_columns
from factorgraph_loc.files.models import FileModel, InUnit, flattened, inside, nearest, parse_json, read_text
from factorgraph_loc.files.tables import Cells, csv_rows, rows_of_length
from factorgraph_loc.text import Notice, listed, notice, quoted, well_formed
from factors.se2 import Integers

TEXT_FIELDS = ("epc_base64",)  # a number is no value of these
JSON_SUFFIXES = (".jsonl", ".ndjson", ".json")
COMMENT = ("#", "//")

EpcCase = Literal["as written", "upper", "lower", "ascii-hex"]
Alternatives = tuple[str, ...]  # columns; one of them is required
Value = bool | int | str


class ReadNames(FileModel):
    """The names in a table or topic of RFID reads."""

    antenna: str | None = None
    """name of the only antenna, if the reads do not name it"""
    antennas: dict[str, str] = Field(default_factory=dict)
    """names in the rig of those of the reads"""
    epc_case: EpcCase = "as written"
    """letter case of EPCs when they are compared with the map; ascii-hex if they are hexadecimal digits of a text"""


class ColumnMapping(FileModel):
    """A table of another program."""

    file: str
    """file of the table, relative to the path of the manifest"""
    columns: dict[str, str]
    """column of the file for each field; in JSON lines a path of keys, such as event.epc; without header the number from 1"""
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
        raise InputError(f"{path}: units.{stray[0]} belongs to no field of columns: map the field, or remove the unit")
    needed: list[Alternatives] = [
        (column,) for field, column in mapping.columns.items() if field not in (*optional, *either)
    ]
    if either:
        needed.append(tuple(mapping.columns[field] for field in either if field in given))
    read = _read_json_lines if path.suffix.lower() in JSON_SUFFIXES else _read_csv
    cells = read(path, mapping, needed)
    if not len(cells.rows):
        raise InputError(f"{path}: contains no rows{' as chosen by where' if mapping.where else ''}")
    return cells


def _mapped(
    path: Path,
    rows: Integers,
    columns: Mapping[str, Sequence[str]],
    mapping: ColumnMapping,
    available: Iterable[str],
    *,
    unwanted: int,
    passed: int = 0,
) -> Cells:
    """The cells by field of the ``columns`` of a file with the columns ``available``."""
    fields = {field: columns[name] for field, name in mapping.columns.items() if name in columns}
    read = {*mapping.columns.values(), *mapping.where}
    left_out = tuple(name for name in available if name not in read)
    labels, units = mapping.columns, mapping.units
    return Cells(path, rows, fields, labels, units, mapping.decimal, left_out, passed, unwanted)


class TableFolder:
    """A folder of tables, with notes on unread rows and columns.

    ``warnings``: about the content of the tables. Several mappings may read one file. A row or column counts as read if one
    of them reads it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[Notice] = []
        self._read: dict[Path, list[tuple[Cells, ColumnMapping]]] = {}

    def file(self, name: str) -> Path:
        """The path of a file in the folder; InputError if it lies elsewhere."""
        return inside(self.path, name, self.path)

    def read(self, mapping: ColumnMapping, shapes: Sequence[Collection[str]]) -> Cells:
        """Read the table of a mapping as :func:`read_mapped`, with :meth:`noted`."""
        return self.noted(read_mapped(self.file(mapping.file), mapping, shapes), mapping)

    def noted(self, cells: Cells, mapping: ColumnMapping) -> Cells:
        """Record which content of their file the ``cells`` use, for warnings about the rest, and return the cells."""
        if cells.passed:
            sentence = "{source}: {objects} objects that lack mapped columns are skipped"
            self.warnings.append(notice("incomplete_objects", sentence, cells.path, cells.passed))
        self._read.setdefault(cells.path, []).append((cells, mapping))
        return cells

    def left_out(self) -> list[Notice]:
        """A warning for each file with rows that no mapping chooses, and one for all files with the same unread columns."""
        warnings = []
        columns: dict[tuple[str, ...], list[str]] = {}
        for path, tables in self._read.items():
            read: set[int] = set()
            count = tables[0][0].unwanted + len(tables[0][0].rows)
            unchosen = count if all(cells.unwanted for cells, _ in tables) else 0
            for rows in (cells.rows.tolist() for cells, _ in tables):
                unchosen -= sum(row not in read for row in rows)  # a line of JSON may hold several
                read.update(rows)
            if unchosen > 0:
                names = listed(dict.fromkeys(name for _, mapping in tables for name in mapping.where))
                sentence = "{source}: {unchosen} of {rows} rows have another {columns} than where says"
                rows_of_file = count + tables[0][0].passed
                warnings.append(notice("unchosen_rows", sentence, path.name, unchosen, rows_of_file, names))
            never = [set(cells.left_out) for cells, _ in tables]
            names_of = tuple(name for name in tables[0][0].left_out if all(name in unread for unread in never))
            columns.setdefault(names_of, []).append(path.name)
        for unread, (first, *more) in columns.items():
            if unread:
                files = f"{first} and {len(more)} more files" if more else first
                warnings.append(unread_columns(files, unread))
        return warnings


def in_case(epcs: Sequence[str], case: EpcCase) -> list[str]:
    """EPCs in the letter case of the comparison with the map, or decoded; those that cannot be decoded are unchanged."""
    if case == "as written":
        return list(epcs)
    if case == "ascii-hex":
        return [text_of_hex(epc) or epc for epc in epcs]
    return [epc.upper() if case == "upper" else epc.lower() for epc in epcs]


def text_of_hex(digits: str) -> str:
    """The ASCII text whose bytes are these hexadecimal digits; "" for others."""
    try:
        return bytes.fromhex(digits).decode("ascii").rstrip("\0")
    except ValueError:
        return ""


def _read_csv(path: Path, mapping: ColumnMapping, needed: Sequence[Alternatives]) -> Cells:
    """The mapped cells of the chosen rows of a table."""
    numbered = [(row, line) for row, line in enumerate(read_text(path).splitlines(), start=1) if line.strip()]
    comments, content = split_comments(numbered)
    if not content:
        raise InputError(f"{path}: contains no rows")
    body = list(parsed(path, content, mapping.separator))
    where = mapping.chosen()
    if mapping.header:
        first_row, first = body[0]
        named = next(parsed(path, comments[-1:], mapping.separator), (0, []))[1]
        # a comment with as many names as there are columns is the header, unless the first row contains the names
        in_comment = _has(named, needed) or (len(named) == len(first) and not _has(first, needed))
        header = named if in_comment else first
        body = body if in_comment else body[1:]
    else:
        # rows of other kinds may have other numbers of columns
        chosen = ((row, parts) for row, parts in body if _is_chosen(parts, _numbers(len(parts)), where))
        first_row, first = next(chosen, body[0])
        header = _numbers(len(first))
    _require_columns(path, mapping, needed, header, first_row)
    kept = [(row, parts) for row, parts in body if _is_chosen(parts, header, where)] if where else body
    rows, columns = rows_of_length(path, header, kept)
    return _mapped(path, rows, columns, mapping, header, unwanted=len(body) - len(kept))


def _numbers(count: int) -> list[str]:
    """The names of ``count`` columns without header."""
    return [str(i) for i in range(1, count + 1)]


def _is_chosen(parts: Sequence[str], header: Sequence[str], where: Mapping[str, set[str]]) -> bool:
    """Whether a row has one of the values of ``where`` in each of its columns."""
    cells = dict(zip(header, parts, strict=False))
    return all(cells.get(name) in values for name, values in where.items())


def split_comments(lines: Sequence[tuple[int, str]]) -> tuple[list[tuple[int, str]], list[tuple[int, str]]]:
    """Split off the comments before the first row, without their marks; the last one may be the header."""
    content = [(row, line) for row, line in lines if not line.lstrip().startswith(COMMENT)]
    until = content[0][0] if content else 0
    comments = [(row, line.lstrip().lstrip("#/").strip()) for row, line in lines if row < until]
    return comments, content


def parsed(path: Path, lines: Sequence[tuple[int, str]], separator: str) -> Iterator[tuple[int, list[str]]]:
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
    objects = list(_objects(path))
    where = mapping.chosen()
    chosen = [(row, o) for row, o in objects if all(_text(o.get(name)) in values for name, values in where.items())]
    filled = [{name for name, value in o.items() if value is not None} for _, o in chosen]
    whole = [entry for entry, names in zip(chosen, filled, strict=True) if _has(names, needed)]
    known = set[str]().union(*filled)
    for alternatives in needed:
        if len(whole) < len(chosen) and not known.intersection(alternatives):
            first = listed(sorted(chosen[0][1]))
            raise InputError(f"{path}: no object has {quoted(alternatives[0])}, the first has {first}")
    columns: dict[str, list[str]] = {}
    texts = {column for field, column in mapping.columns.items() if field in TEXT_FIELDS}
    for name in known.intersection(mapping.columns.values()):
        for row, o in whole:
            value = o.get(name)
            if isinstance(value, list | bool) or (name in texts and not isinstance(value, str | None)):
                raise bad_field(path, name, value, "a text" if name in texts else "a number or a text", row=row)
        columns[name] = [_text(o.get(name)) for _, o in whole]
    names = dict.fromkeys(name for _, o in whole for name in o)
    rows = np.array([row for row, _ in whole], dtype=np.int64)
    unwanted, passed = len(objects) - len(chosen), len(chosen) - len(whole)
    return _mapped(path, rows, columns, mapping, names, unwanted=unwanted, passed=passed)


def _text(value: Any) -> str:
    """A value of JSON or TOML as the text of a cell."""
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else well_formed(str(value))


def _objects(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """The line numbers and the objects of JSON lines, with the values of nested objects by paths of keys, joined by dots."""
    for row, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        content = parse_json(line, f"{path}:{row}")
        entries = content if isinstance(content, list) else [content]
        if not all(isinstance(entry, dict) for entry in entries):
            raise bad_field(path, "line", line.strip()[:80], "an object, or a list of objects", row=row)
        # old versions of sllurp write each number as a list of one
        yield from ((row, {name: _alone(value) for name, value in flattened(entry)}) for entry in entries)


def _alone(value: Any) -> Any:
    """The element of a list of one; any other value itself."""
    return value[0] if isinstance(value, list) and len(value) == 1 else value
