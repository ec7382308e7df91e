"""Tables: their cells and typed rows, and the tables of the native format, CSV with a header or Parquet with the same columns."""

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
import polars as pl
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.bounded import CELLS, DATA, foreign, limited_memory, quiet, read_bytes, require_size
from factorgraph_loc.files.columns import LATEST, STAMP, Column, Table, require_span
from factorgraph_loc.files.models import Model, nearest, parse_model, read_text, write_bytes, write_text
from factorgraph_loc.text import error_text, quoted
from factors.se2 import Array, Integers

SECONDS = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # powers of ten of a nanosecond
ISO = "iso"
MOST_DIGITS = 20  # of a timestamp before its decimal point
NUMBERS, NAMES = ("number", "whole"), ("name", "file")  # kinds of columns
KINDS = {"stamp": pl.Int64, "whole": pl.Int64, "number": pl.Float64, "name": pl.String, "file": pl.String}
T = TypeVar("T")


@dataclass(frozen=True)
class Cells:
    """N rows of a file: the cells of each field, as N texts or as numbers (N,), NaN if empty.

    ``rows`` (N,): line numbers in ``path`` (Parquet: rows from 1). ``labels``: names of the columns in the file, if they differ
    from the fields; ``units``: unit or factor of fields; ``decimal``: decimal mark. ``left_out``: columns of the file that are not
    read. ``passed``: number of JSON objects without any field; ``unwanted``: number of rows that the mapping does not choose.
    """

    path: Path
    rows: Integers
    columns: Mapping[str, Sequence[str] | Array]
    labels: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str | float] = field(default_factory=dict)
    decimal: str = "."
    left_out: tuple[str, ...] = ()
    passed: int = 0
    unwanted: int = 0

    def texts(self, name: str) -> list[str]:
        """The cells (N) of a field as text."""
        return [str(cell) for cell in self.columns[name]]

    def names(self, name: str, column: Column) -> list[str]:
        """The texts (N) of a field; InputError at the first that is empty."""
        texts = self.texts(name)
        if "" in texts:
            raise self.invalid(name, texts.index(""), column.doc)
        return texts

    def numbers(self, name: str, column: Column) -> Array:
        """The numbers (N,) of a field in the unit of ``column``, NaN if empty.

        InputError at the first cell that is no number, not finite, or outside of the column's bounds.
        """
        cells = self.columns[name]
        if isinstance(cells, np.ndarray):
            values, is_empty = cells, np.isnan(cells)
        else:
            values, is_empty = self._floats(name, cells)
        in_file, factor = column.in_unit(self.units.get(name, 1.0), self.path)
        for i in np.flatnonzero(~(np.isfinite(values) | is_empty)).tolist():
            raise self.invalid(name, i, "a finite number")
        if not column.may_lack and is_empty.any():
            raise self.invalid(name, int(is_empty.argmax()), in_file.expected)
        in_file.require(self.path, self.rows, values, self.labels.get(name, name))
        return values if factor == 1.0 else values * factor

    def nanoseconds(self) -> Integers:
        """The timestamps (N,) of the native format, which are whole numbers of nanoseconds."""
        stamps = self._converted(STAMP.name, lambda cell: _limited(int(cell)), STAMP.expected)
        return np.array(stamps, dtype=np.int64)

    def stamps(self, name: str, offset: float = 0.0) -> Integers:
        """The timestamps (N,) of a field in nanoseconds, plus ``offset`` [s]. Times without a zone are UTC."""
        unit = self.units.get(name)
        if unit not in {*SECONDS, ISO}:
            expected = f"one of {', '.join(SECONDS)} or {ISO}"
            raise InputError(f"{self.path}: the unit of {name} is {quoted(unit)}, expected {expected}: units.{name}")
        power, shift = SECONDS.get(str(unit), 0), round(offset * 1e9)
        expected = f"a number of {unit} in {-LATEST / 10**power:g} to {LATEST / 10**power:g}"
        if unit == ISO:
            expected = "a date and time, 2026-01-31T12:00:00.5Z"

        def stamp(text: str) -> int:
            return _limited(shift + (iso_nanoseconds(text) if unit == ISO else self._scaled(text, power)))

        out = np.array(self._converted(name, stamp, expected), dtype=np.int64)
        require_span([(self.path, self.rows, out)])
        return out

    def invalid(self, name: str, i: int, expected: str) -> InputError:
        """The error for cell ``i`` of a field."""
        return bad_field(self.path, self.labels.get(name, name), self.columns[name][i], expected, row=int(self.rows[i]))

    def _converted(self, name: str, convert: Callable[[Any], T], expected: str) -> list[T]:
        """The converted cells of a field; InputError at the first that ``convert`` refuses."""
        out: list[T] = []
        try:
            for cell in self.columns[name]:
                out.append(convert(cell))
        except (ArithmeticError, TypeError, ValueError):
            raise self.invalid(name, len(out), expected) from None
        return out

    def _floats(self, name: str, texts: Sequence[str]) -> tuple[Array, NDArray[np.bool_]]:
        """The numbers (N,) in ``texts`` of a field, NaN if empty; and whether each is empty (N,)."""
        if self.decimal == ".":
            with suppress(ValueError):  # all are numbers: several times as fast
                return np.array(list(map(float, texts)), dtype=float), np.zeros(len(texts), dtype=bool)

        def number(text: str) -> float:
            return float(text.replace(self.decimal, ".")) if text else np.nan

        values = np.array(self._converted(name, number, "a number"), dtype=float)
        return values, np.array([not text for text in texts], dtype=bool)

    def _scaled(self, text: str, power: int) -> int:
        """A decimal number times ten to the ``power``, rounded, without floating-point errors."""
        text = text.replace(self.decimal, ".")
        whole, _, fraction = text.partition(".")
        if len(whole) <= MOST_DIGITS and len(fraction) <= power and (whole + fraction).isdecimal():
            return int(whole + fraction + "0" * (power - len(fraction)))  # several times as fast
        number = Decimal(text)
        if not number.is_finite() or number.adjusted() > MOST_DIGITS:  # checked before the digits are expanded
            raise OverflowError
        return round(number.scaleb(power))


def _limited(stamp: int) -> int:
    if abs(stamp) > LATEST:
        raise OverflowError
    return stamp


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


def csv_rows(path: Path, lines: Sequence[tuple[int, str]], **form: Any) -> Iterator[tuple[int, list[str]]]:
    """The line number and the cells of each row of CSV; ``form``: arguments of :func:`csv.reader`."""
    reader = csv.reader((line for _, line in lines), strict=True, **form)
    try:
        for parts in reader:
            yield lines[reader.line_num - 1][0], parts
    except csv.Error as error:
        raise InputError(f"{path}:{lines[reader.line_num - 1][0]}: is not CSV: {error_text(error)}") from error


def rows_of_length(
    path: Path, header: Sequence[str], rows: Iterable[tuple[int, list[str]]]
) -> tuple[Integers, dict[str, list[str]]]:
    """The line numbers (N,) of rows of CSV, and N cells by column. InputError at a row that is not as long as the header."""
    numbers: list[int] = []
    table: list[list[str]] = []
    for row, parts in rows:
        if len(parts) != len(header):
            raise bad_field(path, "row", ",".join(parts), f"{len(header)} values: {','.join(header)}", row=row)
        numbers.append(row)
        table.append(parts)
    columns = {name: [parts[i] for parts in table] for i, name in enumerate(header)}
    return np.array(numbers, dtype=np.int64), columns


def read_cells(path: Path, tables: Sequence[Table]) -> tuple[Cells, tuple[Column, ...]]:
    """The cells of a CSV, and the columns of the one of ``tables`` that it has. InputError names file and row of invalid
    content."""
    lines = list(enumerate(io.StringIO(read_text(path), newline=""), start=1))
    parsed = csv_rows(path, lines)
    header = [name.strip() for name in next(parsed, (1, []))[1]]
    if not any(header):
        raise InputError(f"{path}: is empty, expected a header {' or '.join(table.header for table in tables)}")
    columns = columns_in(path, header, tables)
    filled = ((row, parts) for row, parts in parsed if len(parts) > 1 or "".join(parts).strip())
    rows, cells = rows_of_length(path, header, filled)
    return Cells(path, rows, cells, left_out=_unread(header, columns)), columns


def columns_in(path: Path, header: Sequence[str], tables: Sequence[Table]) -> tuple[Column, ...]:
    """The columns in ``header`` of the one of ``tables`` with most of them. InputError if one is missing."""
    if len(set(header)) < len(header):
        raise bad_field(path, "header", ",".join(header), "each column once", row=1)
    columns = max(
        (table.in_file(header) for table in tables), key=lambda columns: sum(c.name in header for c in columns)
    )
    missing = next((column.name for column in columns if column.name not in header), None)
    if missing is None:
        return columns
    hint = nearest(missing, list(_unread(header, columns)))
    expected = " or ".join(table.header for table in tables)
    raise InputError(f"{path}:1: column {missing} is missing{hint if 'mean' in hint else ''}, expected {expected}")


def _unread(header: Sequence[str], columns: Sequence[Column]) -> tuple[str, ...]:
    """The names in ``header`` of none of the ``columns``."""
    known = {column.name for column in columns}
    return tuple(name for name in header if name not in known)


def rows_by_name(kind: type[Model], cells: Cells, table: Table, names: Sequence[str]) -> dict[str, Model]:
    """The N rows of a ``table`` as models of ``kind`` by their ``names``, the first column. An empty cell is the default of its
    field.

    InputError names file and row of an empty or repeated name, and of an invalid value.
    """
    column, *fields = table.columns
    numbers = {known.name: cells.numbers(known.name, known) for known in fields if known.name in cells.columns}
    models: dict[str, Model] = {}
    first_rows: dict[str, int] = {}
    for i, (row, name) in enumerate(zip(cells.rows.tolist(), names, strict=True)):
        if not name or name in first_rows:
            expected = f"another name than in row {first_rows[name]}" if name else column.doc
            raise bad_field(cells.path, column.name, name, expected, row=row)
        values = {field: float(rows[i]) for field, rows in numbers.items() if not math.isnan(rows[i])}
        models[name] = parse_model(kind, values, f"{cells.path}:{row}")
        first_rows[name] = row
    return models


def read_parquet(path: Path) -> pl.DataFrame:
    """The table in a Parquet file; InputError if it is invalid or too large."""
    return parse_parquet(read_bytes(path, DATA), path)


def parse_parquet(content: bytes, source: object, columns: Sequence[str] | None = None) -> pl.DataFrame:
    """The table, or some ``columns`` of it, in the bytes of a Parquet file; InputError as in :func:`read_parquet`."""
    with foreign(source, "is not a Parquet file that can be read"), limited_memory(source, len(content)), quiet():
        declared = pl.scan_parquet(io.BytesIO(content))
        rows = declared.select(pl.len()).collect().item()
        require_size(source, "its number of values", rows * len(declared.collect_schema()), CELLS)
        return pl.read_parquet(io.BytesIO(content), columns=None if columns is None else list(columns))


def text_column(table: pl.DataFrame, name: str, source: object) -> list[str]:
    """A column of texts or integers as texts, "" for null; InputError if it has another type."""
    column = table[name]
    kind = column.dtype
    if not (kind in (pl.String, pl.Null, pl.Categorical) or kind.is_integer() or isinstance(kind, pl.Enum)):
        raise InputError(f"{source}: {name} is of type {kind}, expected texts")
    with foreign(source, f"{name} is no column of texts"):
        texts = column.cast(pl.String)
        if len(texts) * texts.estimated_size() > DATA:  # one long text may be referenced many times
            length = int(texts.str.len_bytes().sum())
            require_size(source, f"the length of all texts of {name}", length, DATA)
        return [text or "" for text in texts.to_list()]


@dataclass(frozen=True)
class TableRows:
    """N rows of a table: ``t_ns`` (N,) integers; ``numbers`` by column (N,), NaN if empty; ``names`` by column, N texts.

    ``rows`` (N,): line numbers in ``path`` (Parquet: rows from 1). ``left_out``: other columns of the file.
    """

    path: Path
    rows: Integers
    t_ns: Integers
    numbers: dict[str, Array]
    names: dict[str, list[str]]
    left_out: tuple[str, ...] = ()

    @classmethod
    def of(cls, cells: Cells, columns: Iterable[Column], t_ns: Integers) -> Self:
        """The rows with these timestamps and the cells of ``columns``. InputError at an invalid cell."""
        described = list(columns)
        numbers = {column.name: cells.numbers(column.name, column) for column in described if column.kind in NUMBERS}
        names = {column.name: cells.names(column.name, column) for column in described if column.kind in NAMES}
        return cls(cells.path, cells.rows, t_ns, numbers, names, cells.left_out)

    def rows_at(self, which: Integers) -> Self:
        """The rows with indices ``which`` (M,), in that order."""
        return type(self)(
            self.path,
            self.rows[which],
            self.t_ns[which],
            {name: values[which] for name, values in self.numbers.items()},
            {name: [texts[i] for i in which.tolist()] for name, texts in self.names.items()},
        )


def read_table(path: Path, tables: Sequence[Table]) -> TableRows:
    """Read CSV or Parquet with the columns of one of ``tables``; other columns are ignored.

    InputError names file, row and field of a value that is missing, is not a number, or is out of bounds.
    """
    with limited_memory(path, path.stat().st_size if path.is_file() else 0):
        cells, columns = (_cells_of_parquet if path.suffix == ".parquet" else read_cells)(path, tables)
        return TableRows.of(cells, columns, cells.nanoseconds())


def _cells_of_parquet(path: Path, tables: Sequence[Table]) -> tuple[Cells, tuple[Column, ...]]:
    """The cells of a Parquet file, and the columns of the one of ``tables`` that it has."""
    frame = read_parquet(path)
    columns = columns_in(path, frame.columns, tables)
    cells: dict[str, Any] = {}
    for column in columns:
        name, kind = column.name, frame[column.name].dtype
        if column.kind in NAMES:
            cells[name] = text_column(frame, name, path)
        elif column.kind in NUMBERS:
            if not kind.is_numeric() and kind != pl.Null:
                raise InputError(f"{path}: {name} is of type {kind}, expected numbers")
            cells[name] = frame[name].cast(pl.Float64).to_numpy().copy()
        elif not kind.is_integer():
            raise InputError(f"{path}: {name} is of type {kind}, expected integers, nanoseconds")
        else:
            cells[name] = frame[name].to_list()
    rows = np.arange(1, frame.height + 1, dtype=np.int64)
    return Cells(path, rows, cells, left_out=_unread(frame.columns, columns)), columns


def write_parquet(frame: pl.DataFrame, path: Path) -> None:
    """Write a table as a Parquet file, atomically."""
    content = io.BytesIO()
    frame.write_parquet(content)
    write_bytes(path, content.getvalue())


def write_table(path: Path, tables: Sequence[Table], columns: Mapping[str, Array | Integers | Sequence[str]]) -> None:
    """Write columns of equal length of one of ``tables`` to CSV or Parquet, by suffix, with all digits; NaN becomes an empty
    field."""
    kinds = {column.name: KINDS[column.kind] for table in tables for column in table.columns}
    series = [pl.Series(name, column, dtype=kinds[name]) for name, column in columns.items()]
    frame = pl.DataFrame([s.fill_nan(None) if s.dtype.is_float() else s for s in series])
    if path.suffix == ".parquet":
        write_parquet(frame, path)
    else:
        write_text(path, frame.write_csv())
