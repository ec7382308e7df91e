"""The tables of the native format: CSV with a header, or Parquet with the same columns."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import polars as pl

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.bounded import CELLS, DATA, foreign, limited_memory, quiet, read_bytes, require_size
from factorgraph_loc.files.columns import LATEST, STAMP, Column, Table
from factorgraph_loc.files.models import Model, nearest, parse_model, read_text, write_bytes, write_text
from factorgraph_loc.text import told
from factors.se2 import Array, Integers

Shape = tuple[str, ...]  # the names of columns
NUMBERS, NAMES = ("number", "whole"), ("name", "file")  # kinds of columns
KINDS = {"stamp": pl.Int64, "whole": pl.Int64, "number": pl.Float64, "name": pl.String, "file": pl.String}


@dataclass(frozen=True)
class Cells:
    """N rows of a CSV: ``rows``: N line numbers in ``path``; ``columns``: N cells by name."""

    path: Path
    rows: Sequence[int]
    columns: Mapping[str, Sequence[str]]

    def numbers(self, name: str, column: Column, unit: str | float = 1.0) -> Array:
        """The numbers (N,) of a column, converted from ``unit`` to that of ``column``. An empty cell is NaN.

        InputError at the first cell that is no number, not finite, or outside of the column's bounds.
        """
        cells = self.columns[name]
        found: list[float] = []
        try:
            for cell in cells:
                found.append(float(cell) if cell else math.nan)
        except ValueError:
            i = len(found)
            raise bad_field(self.path, name, cells[i], "a number", row=self.rows[i]) from None
        values = np.array(found, dtype=float)
        if written := [i for i in np.flatnonzero(~np.isfinite(values)).tolist() if cells[i]]:
            raise bad_field(self.path, name, cells[written[0]], "a finite number", row=self.rows[written[0]])
        told, factor = column.in_unit(unit, self.path)
        if not column.may_lack and "" in cells:
            raise bad_field(self.path, name, "", told.expected, row=self.rows[list(cells).index("")])
        told.require(self.path, self.rows, values, name)
        return values if factor == 1.0 else values * factor

    def names(self, name: str, column: Column) -> list[str]:
        """The texts (N) of a column; InputError at the first that is empty."""
        cells = self.columns[name]
        if "" in cells:
            raise bad_field(self.path, name, "", column.doc, row=self.rows[list(cells).index("")])
        return list(cells)


def read_cells(path: Path, shapes: Sequence[Shape]) -> tuple[Cells, Shape]:
    """The cells of a CSV, and the first of ``shapes`` whose columns it has. InputError names file and row of invalid content."""
    rows: list[int] = []
    cells: list[list[str]] = []
    reader = csv.reader(io.StringIO(read_text(path), newline=""), strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        if not any(header):
            raise InputError(f"{path}: is empty, expected a header {' or '.join(','.join(s) for s in shapes)}")
        shape = shape_of(path, header, shapes)
        for parts in reader:
            if len(parts) <= 1 and not "".join(parts).strip():
                continue
            if len(parts) != len(header):
                expected = f"{len(header)} values: {','.join(header)}"
                raise bad_field(path, "row", ",".join(parts), expected, row=reader.line_num)
            rows.append(reader.line_num)
            cells.append(parts)
    except csv.Error as error:
        raise InputError(f"{path}:{reader.line_num}: is not CSV: {told(error)}") from error
    columns = [[parts[i] for parts in cells] for i in range(len(header))]
    return Cells(path, rows, dict(zip(header, columns, strict=True))), shape


def shape_of(path: Path, header: Sequence[str], shapes: Sequence[Shape]) -> Shape:
    """The one of ``shapes`` with most columns in ``header``, the first one if several have all.

    InputError if a column is missing: the best match is what was intended, even if a smaller shape is complete.
    """
    if len(set(header)) < len(header):
        raise bad_field(path, "header", ",".join(header), "each column once", row=1)
    meant = max(shapes, key=lambda shape: (len(set(shape) & set(header)), set(shape) <= set(header)))
    if set(meant) <= set(header):
        return meant
    missing = next(column for column in meant if column not in header)
    hint = nearest(missing, [column for column in header if column not in meant])
    expected = " or ".join(",".join(shape) for shape in shapes)
    raise InputError(f"{path}:1: column {missing} is missing{hint if 'mean' in hint else ''}, expected {expected}")


def rows_by_name(
    kind: type[Model],
    path: Path,
    rows: Sequence[int],
    column: Column,
    names: Sequence[str],
    numbers: Mapping[str, Array],
) -> dict[str, Model]:
    """The N rows of a table as models of ``kind`` by their ``names`` in ``column``.

    ``rows``: N line numbers in ``path``; ``numbers``: values (N,) by field, NaN for the default of the field. InputError names file
    and row of an empty or repeated name, and of an invalid value.
    """
    found: dict[str, Model] = {}
    seen: dict[str, int] = {}
    for i, (row, name) in enumerate(zip(rows, names, strict=True)):
        if not name or name in seen:
            expected = f"another name than in row {seen[name]}" if name else column.doc
            raise bad_field(path, column.name, name, expected, row=row)
        values = {field: float(cells[i]) for field, cells in numbers.items() if not math.isnan(cells[i])}
        found[name] = parse_model(kind, values, f"{path}:{row}")
        seen[name] = row
    return found


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
        found = column.cast(pl.String)
        if len(found) * found.estimated_size() > DATA:  # one long text may be referenced many times
            length = int(found.str.len_bytes().sum())
            require_size(source, f"the length of all texts of {name}", length, DATA)
        return [text or "" for text in found.to_list()]


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
    shapes = [shape for table in tables for shape in table.shapes]
    columns = {column.name: column for table in tables for column in table.columns}
    read = _read_parquet if path.suffix == ".parquet" else _read_csv
    with limited_memory(path, path.stat().st_size if path.is_file() else 0):
        return read(path, columns, shapes)


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


def _read_csv(path: Path, columns: Mapping[str, Column], shapes: Sequence[Shape]) -> TableRows:
    cells, shape = read_cells(path, shapes)
    told = [columns[name] for name in shape]
    return TableRows(
        path,
        np.array(cells.rows, dtype=np.int64),
        _stamps(path, cells.rows, cells.columns[STAMP.name]),
        {c.name: cells.numbers(c.name, c) for c in told if c.kind in NUMBERS},
        {c.name: cells.names(c.name, c) for c in told if c.kind in NAMES},
        tuple(name for name in cells.columns if name not in shape),
    )


def _stamps(path: Path, rows: Sequence[int], cells: Sequence[str]) -> Integers:
    stamps: list[int] = []
    try:
        for cell in cells:
            if abs(stamp := int(cell)) > LATEST:
                raise OverflowError
            stamps.append(stamp)
    except (ValueError, OverflowError):
        i = len(stamps)
        raise bad_field(path, STAMP.name, cells[i], STAMP.expected, row=rows[i]) from None
    return np.array(stamps, dtype=np.int64)


def _read_parquet(path: Path, columns: Mapping[str, Column], shapes: Sequence[Shape]) -> TableRows:
    frame = read_parquet(path)
    shape = shape_of(path, frame.columns, shapes)
    rows = np.arange(1, frame.height + 1, dtype=np.int64)
    if not frame[STAMP.name].dtype.is_integer():
        raise InputError(f"{path}: {STAMP.name} is of type {frame[STAMP.name].dtype}, expected integers, nanoseconds")
    stamps = frame[STAMP.name].cast(pl.Int64, strict=False)
    if missing := np.flatnonzero(stamps.is_null().to_numpy()).tolist():
        raise bad_field(
            path, STAMP.name, frame[STAMP.name][missing[0]], "a whole number of nanoseconds", row=missing[0] + 1
        )
    t_ns = stamps.to_numpy().copy()
    STAMP.require(path, rows, t_ns)
    numbers = {}
    for name in shape:
        if columns[name].kind not in NUMBERS:
            continue
        column = frame[name]
        if not column.dtype.is_numeric() and column.dtype != pl.Null:
            raise InputError(f"{path}: {name} is of type {column.dtype}, expected numbers")
        infinite = np.flatnonzero(~column.cast(pl.Float64).is_finite().fill_null(True).to_numpy())
        if len(infinite):
            i = int(infinite[0])
            raise bad_field(path, name, column[i], "a finite number, or nothing", row=i + 1)
        numbers[name] = column.cast(pl.Float64).to_numpy().copy()
        columns[name].require(path, rows, numbers[name])
    texts = [columns[name] for name in shape if columns[name].kind in NAMES]
    cells = Cells(path, rows.tolist(), {c.name: text_column(frame, c.name, path) for c in texts})
    names = {c.name: cells.names(c.name, c) for c in texts}
    return TableRows(path, rows, t_ns, numbers, names, tuple(name for name in frame.columns if name not in shape))
