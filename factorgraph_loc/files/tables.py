"""The tables of the native format: CSV with a header, or Parquet with the same columns."""

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import polars as pl

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.bounded import CELLS, DATA, foreign, limited_memory, quiet, read_bytes, require_size
from factorgraph_loc.files.cells import NAMES, NUMBERS, Cells, csv_rows, rows_of_length
from factorgraph_loc.files.columns import Column, Table
from factorgraph_loc.files.models import Model, nearest, parse_model, read_text, write_bytes, write_text
from factors.se2 import Array, Integers

Shape = tuple[str, ...]  # the names of columns
KINDS = {"stamp": pl.Int64, "whole": pl.Int64, "number": pl.Float64, "name": pl.String, "file": pl.String}


def read_cells(path: Path, shapes: Sequence[Shape]) -> tuple[Cells, Shape]:
    """The cells of a CSV, and the first of ``shapes`` whose columns it has. InputError names file and row of invalid content."""
    lines = list(enumerate(io.StringIO(read_text(path), newline=""), start=1))
    parsed = csv_rows(path, lines)
    header = [name.strip() for name in next(parsed, (1, []))[1]]
    if not any(header):
        raise InputError(f"{path}: is empty, expected a header {' or '.join(','.join(s) for s in shapes)}")
    shape = shape_of(path, header, shapes)
    filled = ((row, parts) for row, parts in parsed if len(parts) > 1 or "".join(parts).strip())
    rows, columns = rows_of_length(path, header, filled)
    return Cells(path, rows, columns, left_out=tuple(name for name in header if name not in shape)), shape


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
    rows: Integers,
    column: Column,
    names: Sequence[str],
    numbers: Mapping[str, Array],
) -> dict[str, Model]:
    """The N rows of a table as models of ``kind`` by their ``names`` in ``column``.

    ``rows`` (N,): line numbers in ``path``; ``numbers``: values (N,) by field, NaN for the default of the field. InputError names
    file and row of an empty or repeated name, and of an invalid value.
    """
    found: dict[str, Model] = {}
    seen: dict[str, int] = {}
    for i, (row, name) in enumerate(zip(rows.tolist(), names, strict=True)):
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

    @classmethod
    def of(cls, cells: Cells, columns: Iterable[Column], t_ns: Integers) -> Self:
        """The rows with these timestamps and the cells of ``columns``. InputError at an invalid cell."""
        told = list(columns)
        numbers = {column.name: cells.numbers(column.name, column) for column in told if column.kind in NUMBERS}
        names = {column.name: cells.names(column.name, column) for column in told if column.kind in NAMES}
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
    shapes = [shape for table in tables for shape in table.shapes]
    columns = {column.name: column for table in tables for column in table.columns}
    with limited_memory(path, path.stat().st_size if path.is_file() else 0):
        if path.suffix == ".parquet":
            cells, shape = _cells_of_parquet(path, columns, shapes)
        else:
            cells, shape = read_cells(path, shapes)
        return TableRows.of(cells, (columns[name] for name in shape), cells.nanoseconds())


def _cells_of_parquet(path: Path, columns: Mapping[str, Column], shapes: Sequence[Shape]) -> tuple[Cells, Shape]:
    """The cells of a Parquet file, and the one of ``shapes`` whose columns it has."""
    frame = read_parquet(path)
    shape = shape_of(path, frame.columns, shapes)
    found: dict[str, Any] = {}
    for name in shape:
        kind = frame[name].dtype
        if columns[name].kind in NAMES:
            found[name] = text_column(frame, name, path)
        elif columns[name].kind in NUMBERS:
            if not kind.is_numeric() and kind != pl.Null:
                raise InputError(f"{path}: {name} is of type {kind}, expected numbers")
            found[name] = frame[name].cast(pl.Float64).to_numpy().copy()
        elif not kind.is_integer():
            raise InputError(f"{path}: {name} is of type {kind}, expected integers, nanoseconds")
        else:
            found[name] = frame[name].to_list()
    rows = np.arange(1, frame.height + 1, dtype=np.int64)
    return Cells(path, rows, found, left_out=tuple(name for name in frame.columns if name not in shape)), shape


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
