"""Reading of tables of other programs: CSV with any separator, with or without a header, or JSON lines.

A mapping in a manifest assigns columns of the file, with their units, to fields of a sensor's table. The cells are read as text.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.cells import Cells
from factorgraph_loc.files.checks import unread_columns
from factorgraph_loc.files.columns import STAMP, Column
from factorgraph_loc.files.models import FileModel, InUnit, flattened, inside, nearest, parse_json, read_text
from factorgraph_loc.files.row_rules import Fault, RowRules, require_read
from factorgraph_loc.files.tables import csv_rows, rows_of_length
from factorgraph_loc.text import Notice, listed, notice, quoted, well_formed
from factors.se2 import Integers

TEXT_FIELDS = ("epc_base64",)  # fields whose values in JSON must be texts, not numbers
JSON_SUFFIXES = (".jsonl", ".ndjson", ".json")
COMMENT = ("#", "//")

EpcCase = Literal["as written", "upper", "lower", "ascii-hex"]
Alternatives = tuple[str, ...]  # names of columns; a file must have at least one of them
Value = bool | int | str


class ReadNames(FileModel):
    """Settings that convert antenna names and EPCs of RFID reads to the names in the rig and in the map."""

    antenna: str | None = None
    """name of the only antenna, if the reads do not name it"""
    antennas: dict[str, str] = Field(default_factory=dict)
    """name in the rig for each antenna name in the reads"""
    epc_case: EpcCase = "as written"
    """letter case of EPCs when they are compared with the map; ascii-hex decodes hexadecimal digits to a text"""


class ColumnMapping(FileModel):
    """Settings for reading a table of another program. A field is the name that this project has for a column."""

    file: str
    """file of the table, relative to the path of the manifest"""
    columns: dict[str, str]
    """column of the file for each field; in JSON lines a path of keys, such as event.epc; without header the number from 1"""
    units: dict[str, str | float] = Field(default_factory=dict)
    """unit of each field, or the factor that converts its values to the unit of the native format"""
    separator: Literal[",", ";", "\t", " "] = ","
    """separator of the columns"""
    decimal: Literal[".", ","] = "."
    """decimal mark"""
    header: bool = True
    """whether the first row has the names of the columns"""
    where: dict[str, Value | tuple[Value, ...]] = Field(default_factory=dict)
    """which rows to read: by column of the file, the value or the list of possible values"""

    def chosen(self) -> dict[str, set[str]]:
        """Return the setting ``where`` as {column: texts}. A row is read if each of these columns has one of its texts."""
        return {
            column: {_text(value) for value in (values if isinstance(values, tuple) else (values,))}
            for column, values in self.where.items()
        }


class TimedMapping(ColumnMapping, RowRules):
    """Settings for reading a table with timestamps of another program."""

    clock_offset: Annotated[float, Field(ge=-1e10, le=1e10), InUnit("s")] = 0.0
    """added to all timestamps"""


def read_mapped(
    path: Path,
    mapping: ColumnMapping,
    shapes: Sequence[Collection[str]],
    optional: Collection[str] = (),
    either: Collection[str] = (),
) -> Cells:
    """Read the columns of the file ``path`` that ``mapping.columns`` assigns to fields. Return the cells by field.

    ``shapes``: alternative sets of fields. The mapping must have all fields of one set.
    ``optional``: further fields that the mapping may have. The file may lack their columns.
    ``either``: fields in ``shapes``. The file must have the column of at least one of them.

    Raises InputError if the mapping or the file is invalid, or if no row has the values in ``mapping.where``.
    """
    given = set(mapping.columns)
    known = set(optional).union(*shapes)
    if unknown := sorted(given - known):
        raise InputError(f"{path}: unknown field {quoted(unknown[0])} in columns{nearest(unknown[0], sorted(known))}")
    if not any(set(shape) <= given <= set(shape).union(optional) for shape in shapes):
        expected = " or ".join(", ".join(shape) for shape in shapes)
        raise InputError(f"{path}: columns has {listed(sorted(given)) or 'nothing'}, expected the fields {expected}")
    if stray := sorted(set(mapping.units) - given):
        raise InputError(f"{path}: units.{stray[0]} belongs to no field in columns: add the field, or remove the unit")
    needed: list[Alternatives] = [
        (column,) for field, column in mapping.columns.items() if field not in (*optional, *either)
    ]
    if either:
        needed.append(tuple(mapping.columns[field] for field in either if field in given))
    read = _read_json_lines if path.suffix.lower() in JSON_SUFFIXES else _read_csv
    cells = read(path, mapping, needed)
    if not len(cells.rows):
        raise InputError(
            f"{path}: contains no rows{' with the values that the key where requires' if mapping.where else ''}"
        )
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
    unread: tuple[tuple[int, str], ...] = (),
) -> Cells:
    """Return the cells of a file by field, as ``mapping`` assigns them. ``columns``: {column: the cells of N rows}.

    ``rows`` (N,): line numbers. ``available``: all column names. The other arguments become fields of the cells."""
    fields = {field: columns[name] for field, name in mapping.columns.items() if name in columns}
    read = {*mapping.columns.values(), *mapping.where}
    left_out = tuple(name for name in available if name not in read)
    labels, units = mapping.columns, mapping.units
    rules = _rules(mapping)
    return Cells(path, rows, fields, labels, units, mapping.decimal, left_out, passed, unwanted, rules, unread)


def _rules(mapping: ColumnMapping) -> RowRules | None:
    """Return the rules for invalid rows of a table with timestamps. Returns None for other tables, such as maps."""
    return mapping if isinstance(mapping, TimedMapping) else None


class TableFolder:
    """Reads the tables of a log from a folder, and records which rows and columns are read.

    A mapping assigns columns of a file to fields, and several mappings may read the same file. ``warnings``: a list of
    warnings about the content of the tables.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[Notice] = []
        self._read: dict[Path, list[tuple[Cells, ColumnMapping]]] = {}

    def file(self, name: str) -> Path:
        """Return the path of a file in the folder. Raises InputError if the path leads out of the folder."""
        return inside(self.path, name, self.path)

    def read(self, mapping: TimedMapping, shapes: Sequence[Collection[str]], columns: Mapping[str, Column]) -> Cells:
        """Return the valid cells of the file that ``mapping`` names, and record its rows and columns as read.

        ``shapes``: alternative sets of fields; the mapping must have all fields of one set. ``columns``: describes each
        field. Raises InputError at an invalid cell, unless ``mapping`` skips invalid rows.
        """
        return self.record_read(read_mapped(self.file(mapping.file), mapping, shapes), mapping, columns)

    def record_read(
        self, cells: Cells, mapping: TimedMapping, columns: Mapping[str, Column], more: Sequence[Fault] = ()
    ) -> Cells:
        """Record that the rows and columns of ``cells`` are read. Return the valid cells, sorted by time if ``mapping``
        sets it.

        ``columns``: the description of each field. ``more``: invalid cells that the caller has found in addition.
        """
        if cells.passed:
            sentence = "{source}: {objects} objects that lack keys in columns are skipped"
            self.warnings.append(notice("incomplete_objects", sentence, cells.path, cells.passed))
        self._read.setdefault(cells.path, []).append((cells, mapping))
        own = {"t": STAMP} | {name: columns[name] for name in cells.columns if name in columns}
        return cells.usable(own, self.warnings, offset=mapping.clock_offset, more=more)

    def left_out(self) -> list[Notice]:
        """Return warnings about the rows and columns that no mapping reads."""
        warnings = []
        columns: dict[tuple[str, ...], list[str]] = {}
        for path, tables in self._read.items():
            read: set[int] = set()
            count = tables[0][0].unwanted + len(tables[0][0].rows) + len(tables[0][0].unread)
            unchosen = count if all(cells.unwanted for cells, _ in tables) else 0
            for rows in ([*cells.rows.tolist(), *(row for row, _ in cells.unread)] for cells, _ in tables):
                unchosen -= sum(row not in read for row in rows)  # the rows of one JSON line have the same row number
                read.update(rows)
            if unchosen > 0:
                names = listed(dict.fromkeys(name for _, mapping in tables for name in mapping.where))
                sentence = "{source}: {unchosen} of {rows} rows are not read: where excludes their values of {columns}"
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
    """Return EPCs in the letter case ``case``. For "ascii-hex", decode hexadecimal EPCs to ASCII if possible."""
    if case == "as written":
        return list(epcs)
    if case == "ascii-hex":
        return [text_of_hex(epc) or epc for epc in epcs]
    return [epc.upper() if case == "upper" else epc.lower() for epc in epcs]


def text_of_hex(digits: str) -> str:
    """Decode hexadecimal digits to an ASCII text without trailing NULs. Return "" if they are no ASCII text."""
    try:
        return bytes.fromhex(digits).decode("ascii").rstrip("\0")
    except ValueError:
        return ""


def _read_csv(path: Path, mapping: ColumnMapping, needed: Sequence[Alternatives]) -> Cells:
    """Return the columns of a CSV file that ``mapping`` assigns to fields, in the rows that its ``where`` selects.

    ``needed``: groups of columns. Raises InputError if the file lacks all columns of a group."""
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
        # rows that ``where`` excludes may have other numbers of columns
        chosen = ((row, parts) for row, parts in body if _is_chosen(parts, _numbers(len(parts)), where))
        first_row, first = next(chosen, body[0])
        header = _numbers(len(first))
        if (rules := _rules(mapping)) is not None and rules.bad_rows == "skip":  # the first row may be cut off
            lengths = Counter(len(parts) for _, parts in body if _is_chosen(parts, _numbers(len(parts)), where))
            header = _numbers(lengths.most_common(1)[0][0] if lengths else len(first))
    _require_columns(path, mapping, needed, header, first_row)
    kept = [(row, parts) for row, parts in body if _is_chosen(parts, header, where)] if where else body
    rows, columns, unread = rows_of_length(path, header, kept, _rules(mapping))
    return _mapped(path, rows, columns, mapping, header, unwanted=len(body) - len(kept), unread=unread)


def _numbers(count: int) -> list[str]:
    """Return the names "1", "2", ... of the ``count`` columns of a file without a header."""
    return [str(i) for i in range(1, count + 1)]


def _is_chosen(parts: Sequence[str], header: Sequence[str], where: Mapping[str, set[str]]) -> bool:
    """True if a row has one of the allowed values in each column of ``where``.

    ``parts``: the cells of the row. ``header``: the names of the columns."""
    cells = dict(zip(header, parts, strict=False))
    return all(cells.get(name) in values for name, values in where.items())


def split_comments(lines: Sequence[tuple[int, str]]) -> tuple[list[tuple[int, str]], list[tuple[int, str]]]:
    """Separate the comments at the start of a file from the rows of data. ``lines``: line numbers and texts.

    Returns two lists of line numbers and texts: the comments without comment marks, and the rows of data. The last
    comment may be the header.
    """
    content = [(row, line) for row, line in lines if not line.lstrip().startswith(COMMENT)]
    until = content[0][0] if content else 0
    comments = [(row, line.lstrip().lstrip("#/").strip()) for row, line in lines if row < until]
    return comments, content


def parsed(path: Path, lines: Sequence[tuple[int, str]], separator: str) -> Iterator[tuple[int, list[str]]]:
    """Split the lines of a CSV file at ``separator``. Yield the line number and the cells of each row.

    ``lines``: line numbers and texts.
    """
    if separator == " ":  # any number of blanks separates columns
        return ((row, line.split()) for row, line in lines)
    rows = csv_rows(path, lines, delimiter=separator, skipinitialspace=True)
    return ((row, [part.strip() for part in parts]) for row, parts in rows)


def _has(names: Collection[str], needed: Sequence[Alternatives]) -> bool:
    """True if ``names`` has at least one column of each group of columns in ``needed``."""
    return all(any(column in names for column in columns) for columns in needed)


def _require_columns(
    path: Path, mapping: ColumnMapping, needed: Sequence[Alternatives], header: Sequence[str], row: int
) -> None:
    """Raise InputError if a needed column is missing in ``header``, or if ``header`` has a mapped column twice.

    ``needed``: groups of columns; the file needs one column of each group. ``row``: line number of the header."""
    counts = Counter(header)
    for columns in [*needed, *((column,) for column in mapping.where)]:
        if not _has(counts, [columns]):
            raise InputError(f"{path}:{row}: has no column {quoted(columns[0])}, it has {listed(header)}")
    for column in (*mapping.columns.values(), *mapping.where):
        if counts[column] > 1:
            raise InputError(f"{path}:{row}: has the column {quoted(column)} more than once")


def _read_json_lines(path: Path, mapping: ColumnMapping, needed: Sequence[Alternatives]) -> Cells:
    """Return the mapped columns of a file whose lines are JSON objects or lists of JSON objects.

    ``needed``: groups of columns. Objects that lack all columns of a group, or that ``where`` excludes, are ignored.
    Raises InputError if no object has a column of a group."""
    unread: list[tuple[int, str]] = []
    objects = list(_objects(path, unread))
    where = mapping.chosen()
    chosen = [(row, o) for row, o in objects if all(_text(o.get(name)) in values for name, values in where.items())]
    filled = [{name for name, value in o.items() if value is not None} for _, o in chosen]
    whole = [entry for entry, names in zip(chosen, filled, strict=True) if _has(names, needed)]
    known = set[str]().union(*filled)
    for alternatives in needed:
        if len(whole) < len(chosen) and not known.intersection(alternatives):
            first = listed(sorted(chosen[0][1]))
            raise InputError(
                f"{path}: no object has the key {quoted(alternatives[0])}, the first object has the keys {first}"
            )
    passed, fields = len(chosen) - len(whole), sorted(known.intersection(mapping.columns.values()))
    texts = {column for field, column in mapping.columns.items() if field in TEXT_FIELDS}
    errors = [_wrong_value(path, row, o, fields, texts) for row, o in whole]
    unread += [(row, error) for (row, _), error in zip(whole, errors, strict=True) if error]
    require_read(sorted(unread), len(whole) + len(unread), _rules(mapping))
    whole = [entry for entry, error in zip(whole, errors, strict=True) if not error]
    columns = {name: [_text(o.get(name)) for _, o in whole] for name in fields}
    names = dict.fromkeys(name for _, o in whole for name in o)
    rows = np.array([row for row, _ in whole], dtype=np.int64)
    unwanted = len(objects) - len(chosen)
    return _mapped(path, rows, columns, mapping, names, unwanted=unwanted, passed=passed, unread=tuple(unread))


def _wrong_value(path: Path, row: int, entry: Mapping[str, Any], fields: Sequence[str], texts: Collection[str]) -> str:
    """Return an error message about the first field of the object ``entry`` with a value of a wrong type, or "".

    ``fields``: the fields to check. ``texts``: those fields that must be texts. ``row``: line number of the object."""
    for name in fields:
        value = entry.get(name)
        if isinstance(value, list | bool) or (name in texts and not isinstance(value, str | None)):
            expected = "a text" if name in texts else "a number or a text"
            return str(bad_field(path, name, value, expected, row=row))
    return ""


def _text(value: Any) -> str:
    """Return a value of JSON or TOML as the text that a cell of CSV would have. None becomes ""."""
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else well_formed(str(value))


def _objects(path: Path, unread: list[tuple[int, str]]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the line number and the content of each object in a file of JSON lines.

    Nested objects are flattened: the value of ``b`` in ``a`` has the key ``a.b``. The number and the error of each
    invalid line are appended to ``unread``."""
    for row, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            content = parse_json(line, f"{path}:{row}")
            entries = content if isinstance(content, list) else [content]
            if not all(isinstance(entry, dict) for entry in entries):
                raise bad_field(path, "line", line.strip()[:80], "an object, or a list of objects", row=row)
        except InputError as error:
            unread.append((row, str(error)))
            continue
        # old versions of sllurp write each number as a list of one
        yield from ((row, {name: _without_single_list(value) for name, value in flattened(entry)}) for entry in entries)


def _without_single_list(value: Any) -> Any:
    """Return the element of a list that has one element. Return any other value unchanged."""
    return value[0] if isinstance(value, list) and len(value) == 1 else value
