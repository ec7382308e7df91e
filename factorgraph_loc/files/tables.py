"""The tables of the native format: CSV with a header, or Parquet with the same columns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import polars as pl

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import LATEST, STAMP, Column, Table
from factorgraph_loc.files.csv_cells import Shape, read_cells, shape_of
from factorgraph_loc.files.parquet import read_parquet, text_column
from factors.se2 import Array, Integers

NUMBERS, NAMES = ("number", "whole"), ("name", "file")  # kinds of columns
KINDS = {"stamp": pl.Int64, "whole": pl.Int64, "number": pl.Float64, "name": pl.String, "file": pl.String}


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
    return _read_parquet(path, columns, shapes) if path.suffix == ".parquet" else _read_csv(path, columns, shapes)


def write_table(path: Path, tables: Sequence[Table], columns: Mapping[str, Array | Integers | Sequence[str]]) -> None:
    """Write columns of equal length of one of ``tables`` to CSV or Parquet, by suffix, with all digits; NaN becomes an empty
    field."""
    kinds = {column.name: KINDS[column.kind] for table in tables for column in table.columns}
    series = [pl.Series(name, column, dtype=kinds[name]) for name, column in columns.items()]
    frame = pl.DataFrame([s.fill_nan(None) if s.dtype.is_float() else s for s in series])
    if path.suffix == ".parquet":
        frame.write_parquet(path)
    else:
        frame.write_csv(path)


def _read_csv(path: Path, columns: Mapping[str, Column], shapes: Sequence[Shape]) -> TableRows:
    cells, shape = read_cells(path, shapes)
    told = [columns[name] for name in shape]
    return TableRows(
        path,
        np.array(cells.rows, dtype=np.int64),
        _stamps(path, cells.rows, cells.columns[STAMP.name]),
        {c.name: cells.numbers(c.name, c) for c in told if c.kind in NUMBERS},
        {c.name: _texts(path, cells.rows, c, cells.columns[c.name]) for c in told if c.kind in NAMES},
        tuple(name for name in cells.columns if name not in shape),
    )


def _stamps(path: Path, rows: Sequence[int], cells: Sequence[str]) -> Integers:
    try:
        stamps = np.array([int(cell) for cell in cells], dtype=np.int64)
    except (ValueError, OverflowError):
        i = next(i for i, cell in enumerate(cells) if not _is_stamp(cell))
        raise bad_field(path, STAMP.name, cells[i], STAMP.expected, row=rows[i]) from None
    STAMP.require(path, rows, stamps)
    return stamps


def _is_stamp(cell: str) -> bool:
    try:
        return abs(int(cell)) <= LATEST
    except ValueError:
        return False


def _texts(path: Path, rows: Sequence[int], column: Column, cells: Sequence[str | None]) -> list[str]:
    texts = []
    for row, cell in zip(rows, cells, strict=True):
        if not cell:
            raise bad_field(path, column.name, cell, column.doc, row=row)
        texts.append(cell)
    return texts


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
    names = {c.name: _texts(path, rows.tolist(), c, text_column(frame, c.name, path)) for c in texts}
    return TableRows(path, rows, t_ns, numbers, names, tuple(name for name in frame.columns if name not in shape))
