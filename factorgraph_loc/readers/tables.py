"""The tables of the native format: CSV with a header, or Parquet with the same columns."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import nearest, read_text
from factorgraph_loc.trajectory import Integers
from factors.se2 import Array

STAMP = "t_ns"
NAME = "landmark"
TEXT = {STAMP, NAME}  # columns that are not decimal numbers
MAX_STAMP = 2**62  # ns: leaves room for differences in 64 bits


@dataclass(frozen=True)
class Table:
    """Columns of N rows: ``t_ns`` (N,) integers, ``numbers`` by column (N,) with NaN where empty, ``names`` N landmarks.

    ``rows`` (N,): where each stands in ``path``, as an editor counts lines (Parquet: rows from 1). ``columns``: all of its header.
    """

    path: Path
    rows: Integers
    columns: tuple[str, ...]
    t_ns: Integers
    numbers: dict[str, Array]
    names: list[str]


def read_table(path: Path, shapes: Sequence[tuple[str, ...]]) -> Table:
    """Read CSV or Parquet with the columns of one of ``shapes``, in any order; other columns are not looked at.

    InputError names file, row and field of what is missing or is not a number.
    """
    return _read_parquet(path, shapes) if path.suffix == ".parquet" else _read_csv(path, shapes)


def write_table(path: Path, columns: Mapping[str, Array | Integers | Sequence[str]]) -> None:
    """Write columns of equal length to CSV or Parquet, as the suffix says; NaN becomes an empty field. Numbers keep all digits."""
    series = [pl.Series(name, column) for name, column in columns.items()]
    frame = pl.DataFrame([s if s.name in TEXT else s.fill_nan(None) for s in series])
    if path.suffix == ".parquet":
        frame.write_parquet(path)
    else:
        frame.write_csv(path)


def _shape(path: Path, header: Sequence[str], shapes: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """The first of ``shapes`` whose columns are all in ``header``."""
    if len(set(header)) < len(header):
        raise bad_field(path, "header", ",".join(header), "each column once", row=1)
    for shape in shapes:
        if set(shape) <= set(header):
            return shape
    # the shape that is meant is the one with most of its columns there
    meant = max(shapes, key=lambda shape: len(set(shape) & set(header)))
    missing = next(column for column in meant if column not in header)
    hint = nearest(missing, [column for column in header if column not in meant])
    expected = " or ".join(",".join(shape) for shape in shapes)
    raise InputError(f"{path}:1: column {missing} is missing{hint if 'mean' in hint else ''}, expected {expected}")


def _read_csv(path: Path, shapes: Sequence[tuple[str, ...]]) -> Table:
    rows: list[int] = []
    cells: list[list[str]] = []
    reader = csv.reader(io.StringIO(read_text(path), newline=""), strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        if not any(header):
            raise InputError(f"{path}: is empty, expected a header {' or '.join(','.join(s) for s in shapes)}")
        shape = _shape(path, header, shapes)
        for parts in reader:
            if len(parts) <= 1 and not "".join(parts).strip():
                continue
            if len(parts) != len(header):
                expected = f"{len(header)} values: {','.join(header)}"
                raise bad_field(path, "row", ",".join(parts), expected, row=reader.line_num)
            rows.append(reader.line_num)
            cells.append(parts)
    except csv.Error as error:
        raise InputError(f"{path}:{reader.line_num}: is not CSV: {error}") from error
    columns = dict(zip(header, zip(*cells, strict=True), strict=True)) if cells else dict.fromkeys(header, ())
    numbers = {name: _decimals(path, rows, name, columns[name]) for name in shape if name not in TEXT}
    names = _landmarks(path, rows, columns[NAME]) if NAME in shape else []
    t_ns = _stamps(path, rows, columns[STAMP])
    return Table(path, np.array(rows, dtype=np.int64), tuple(header), t_ns, numbers, names)


def _decimals(path: Path, rows: Sequence[int], name: str, cells: Sequence[str]) -> Array:
    """Cells as numbers, an empty one as NaN; what is written as NaN or infinite is wrong."""
    values = np.empty(len(cells))
    for i, cell in enumerate(cells):
        try:
            values[i] = float(cell) if cell else np.nan
        except ValueError:
            raise bad_field(path, name, cell, "a number", row=rows[i]) from None
    bad = np.flatnonzero(~np.isfinite(values) & np.array([bool(cell) for cell in cells], dtype=bool))
    if len(bad):
        raise bad_field(path, name, cells[bad[0]], "a finite number", row=rows[bad[0]])
    return values


def _stamps(path: Path, rows: Sequence[int], cells: Sequence[str]) -> Integers:
    stamps = []
    for row, cell in zip(rows, cells, strict=True):
        try:
            stamp = int(cell)
        except ValueError:
            raise bad_field(path, STAMP, cell, "a whole number of nanoseconds", row=row) from None
        if abs(stamp) > MAX_STAMP:
            raise bad_field(path, STAMP, cell, "nanoseconds below 2^62", row=row)
        stamps.append(stamp)
    return np.array(stamps, dtype=np.int64)


def _landmarks(path: Path, rows: Sequence[int], cells: Sequence[str | None]) -> list[str]:
    names = []
    for row, cell in zip(rows, cells, strict=True):
        if not cell:
            raise bad_field(path, NAME, cell, "the name of a landmark", row=row)
        names.append(cell)
    return names


def _read_parquet(path: Path, shapes: Sequence[tuple[str, ...]]) -> Table:
    try:
        frame = pl.read_parquet(path)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise InputError(f"{path}: is not a Parquet file that can be read") from error
    shape = _shape(path, frame.columns, shapes)
    rows = np.arange(1, frame.height + 1, dtype=np.int64)
    if not frame[STAMP].dtype.is_integer():
        raise InputError(f"{path}: {STAMP} is of type {frame[STAMP].dtype}, expected integers, nanoseconds")
    stamps = frame[STAMP].cast(pl.Int64, strict=False)
    if missing := np.flatnonzero(stamps.is_null().to_numpy()).tolist():
        raise bad_field(path, STAMP, frame[STAMP][missing[0]], "a whole number of nanoseconds", row=missing[0] + 1)
    numbers = {}
    for name in shape:
        if name in TEXT:
            continue
        column = frame[name]
        if not column.dtype.is_numeric():
            raise InputError(f"{path}: {name} is of type {column.dtype}, expected numbers")
        infinite = np.flatnonzero(~column.cast(pl.Float64).is_finite().fill_null(True).to_numpy())
        if len(infinite):
            i = int(infinite[0])
            raise bad_field(path, name, column[i], "a finite number, or nothing", row=i + 1)
        numbers[name] = column.cast(pl.Float64).to_numpy().copy()
    names = _landmarks(path, rows.tolist(), frame[NAME].cast(pl.String).to_list()) if NAME in shape else []
    return Table(path, rows, tuple(frame.columns), stamps.to_numpy().copy(), numbers, names)
