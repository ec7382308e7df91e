"""Reading and writing of tables of the native format, and their typed rows.

A table of the native format is a CSV file with a header, or a Parquet file with the same columns.
"""

import csv
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import polars as pl
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.bounded import CELLS, DATA, foreign, limited_memory, quiet, read_bytes, require_size
from factorgraph_loc.files.cells import NAMES, NUMBERS, Cells
from factorgraph_loc.files.columns import Column, Table
from factorgraph_loc.files.models import Model, nearest, parse_model, read_text, write_bytes, write_text
from factorgraph_loc.files.row_rules import RowRules, require_read
from factorgraph_loc.text import Notice, error_text
from factors.se2 import Array, Integers

KINDS = {"stamp": pl.Int64, "whole": pl.Int64, "number": pl.Float64, "name": pl.String, "file": pl.String}


def csv_rows(path: Path, lines: Sequence[tuple[int, str]], **form: Any) -> Iterator[tuple[int, list[str]]]:
    """Parse CSV. Yield the line number and the cells of each row.

    ``lines``: the lines with their numbers. ``form``: arguments of :func:`csv.reader`. Raises InputError if a line is not CSV.
    """
    reader = csv.reader((line for _, line in lines), strict=True, **form)
    try:
        for parts in reader:
            yield lines[reader.line_num - 1][0], parts
    except csv.Error as error:
        raise InputError(f"{path}:{lines[reader.line_num - 1][0]}: is not CSV: {error_text(error)}") from error


def rows_of_length(
    path: Path, header: Sequence[str], rows: Iterable[tuple[int, list[str]]], rules: RowRules | None = None
) -> tuple[Integers, dict[str, list[str]], tuple[tuple[int, str], ...]]:
    """Return the rows of a CSV file as (line numbers (N,), {name in ``header``: N cells}, rejected rows).

    ``rows``: line number and cells of each row. A rejected row has a wrong number of cells, and is given as (line
    number, error). Raises InputError at the first such row unless ``rules`` skip it.
    """
    numbers: list[int] = []
    table: list[list[str]] = []
    unread: list[tuple[int, str]] = []
    expected = f"{len(header)} values: {','.join(header)}"
    for row, parts in rows:
        if len(parts) == len(header):
            numbers.append(row)
            table.append(parts)
        else:
            unread.append((row, str(bad_field(path, "row", ",".join(parts), expected, row=row))))
    require_read(unread, len(table) + len(unread), rules)
    columns = {name: [parts[i] for parts in table] for i, name in enumerate(header)}
    return np.array(numbers, dtype=np.int64), columns, tuple(unread)


def read_cells(path: Path, tables: Sequence[Table], rules: RowRules | None = None) -> tuple[Cells, tuple[Column, ...]]:
    """Return the cells of a CSV file that contains one of several possible ``tables``, and descriptions of its columns.

    The columns are those of the table that fits the header of the file best. ``rules``: whether invalid rows are
    skipped. None: they are errors. Raises InputError if the content is invalid.
    """
    lines = list(enumerate(io.StringIO(read_text(path), newline=""), start=1))
    parsed = csv_rows(path, lines)
    header = [name.strip() for name in next(parsed, (1, []))[1]]
    if not any(header):
        raise InputError(f"{path}: is empty, expected a header {' or '.join(table.header for table in tables)}")
    columns = columns_in(path, header, tables)
    filled = ((row, parts) for row, parts in parsed if len(parts) > 1 or "".join(parts).strip())
    rows, cells, unread = rows_of_length(path, header, filled, rules)
    return Cells(path, rows, cells, left_out=_unread(header, columns), rules=rules, unread=unread), columns


def columns_in(path: Path, header: Sequence[str], tables: Sequence[Table]) -> tuple[Column, ...]:
    """Return the columns to read from a file with the column names ``header``.

    They are the columns of that table of ``tables`` which has the most columns in common with ``header``. Raises
    InputError if a required column of this table is missing, or if ``header`` has a name twice.
    """
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
    """Return the names in ``header`` that none of the ``columns`` has."""
    known = {column.name for column in columns}
    return tuple(name for name in header if name not in known)


def rows_by_name(kind: type[Model], cells: Cells, table: Table, names: Sequence[str]) -> dict[str, Model]:
    """Convert the N rows of a table to models of class ``kind``, such as the tags of a map. Return them by name.

    ``names``: N names, the first column of ``table``. ``cells``: the other columns, which are the fields of ``kind``.
    An empty cell gives the default of the field. Raises InputError for an empty or repeated name, or an invalid value.
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
    """Return the table in a Parquet file. Raises InputError if the file is invalid or too large."""
    return parse_parquet(read_bytes(path, DATA), path)


def parse_parquet(content: bytes, source: object, columns: Sequence[str] | None = None) -> pl.DataFrame:
    """Return the table in ``content``, the bytes of the Parquet file ``source``, or only some ``columns`` of it.

    Raises InputError if the content is invalid or too large.
    """
    with foreign(source, "is not a Parquet file that can be read"), limited_memory(source, len(content)), quiet():
        declared = pl.scan_parquet(io.BytesIO(content))
        rows = declared.select(pl.len()).collect().item()
        require_size(source, "its number of values", rows * len(declared.collect_schema()), CELLS)
        return pl.read_parquet(io.BytesIO(content), columns=None if columns is None else list(columns))


def text_column(table: pl.DataFrame, name: str, source: object) -> list[str]:
    """Return the column ``name`` of a table in the file ``source`` as texts. Integers are converted, null becomes "".

    Raises InputError if the column has another type, or its texts are too long in total.
    """
    column = table[name]
    kind = column.dtype
    if not (kind in (pl.String, pl.Null, pl.Categorical) or kind.is_integer() or isinstance(kind, pl.Enum)):
        raise InputError(f"{source}: {name} is of type {kind}, expected texts")
    with foreign(source, f"{name} is no column of texts"):
        texts = column.cast(pl.String)
        # the exact length is computed only if this upper bound of it exceeds the limit
        if len(texts) * texts.estimated_size() > DATA:
            length = int(texts.str.len_bytes().sum())
            require_size(source, f"the length of all texts of {name}", length, DATA)
        return [text or "" for text in texts.to_list()]


@dataclass(frozen=True)
class TableRows:
    """The parsed values of N rows of a table.

    ``rows`` (N,): line numbers in the file ``path``, or row numbers from 1 in a Parquet file. ``t_ns`` (N,): timestamps
    [ns]. ``numbers``: numbers (N,) of each column in ``Column.unit``, NaN for empty cells. ``names``: N texts of each
    column of names. ``left_out``: columns of the file that are not read.
    ``rules``: whether invalid rows are skipped, and rows sorted by time. None: invalid rows and decreasing times are errors.
    ``resumed`` (N,): True for each row that follows a skipped row.
    """

    path: Path
    rows: Integers
    t_ns: Integers
    numbers: dict[str, Array]
    names: dict[str, list[str]]
    left_out: tuple[str, ...] = ()
    rules: RowRules | None = None
    resumed: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __post_init__(self) -> None:
        if len(self.resumed) != len(self.rows):
            object.__setattr__(self, "resumed", np.zeros(len(self.rows), dtype=bool))

    @classmethod
    def of(cls, cells: Cells, columns: Iterable[Column], t_ns: Integers) -> Self:
        """Return the rows with parsed values of ``cells`` in the given columns. ``t_ns`` (N,): timestamps of the rows
        [ns]. Raises InputError at an invalid cell."""
        described = list(columns)
        numbers = {column.name: cells.numbers(column.name, column) for column in described if column.kind in NUMBERS}
        names = {column.name: cells.names(column.name, column) for column in described if column.kind in NAMES}
        return cls(cells.path, cells.rows, t_ns, numbers, names, cells.left_out, cells.rules, cells.resumed)

    def rows_at(self, which: Integers) -> Self:
        """Return the rows with the indices ``which`` (M,), in the order of ``which``."""
        return type(self)(
            self.path,
            self.rows[which],
            self.t_ns[which],
            {name: values[which] for name, values in self.numbers.items()},
            {name: [texts[i] for i in which.tolist()] for name, texts in self.names.items()},
            rules=self.rules,
            resumed=self.resumed[which],
        )


def read_table(path: Path, tables: Sequence[Table], rules: RowRules, warnings: list[Notice]) -> TableRows:
    """Return the rows of a CSV or Parquet file, which contains one of several possible ``tables``.

    Columns that the table lacks are ignored. Raises InputError if a value is missing, is not a number, or is out of
    bounds, unless ``rules`` skip such rows. If rows are skipped or sorted, a warning is appended to ``warnings``.
    """
    with limited_memory(path, path.stat().st_size if path.is_file() else 0):
        cells, columns = (_cells_of_parquet if path.suffix == ".parquet" else read_cells)(path, tables, rules)
        cells = cells.usable({column.name: column for column in columns}, warnings)
        return TableRows.of(cells, columns, cells.nanoseconds())


def _cells_of_parquet(path: Path, tables: Sequence[Table], rules: RowRules | None) -> tuple[Cells, tuple[Column, ...]]:
    """Return the cells of a Parquet file that contains one of ``tables``, and the columns of that table.

    ``rules``: whether invalid rows are skipped, and rows sorted by time. They become a field of the cells."""
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
            raise InputError(f"{path}: {name} is of type {kind}, expected integers in nanoseconds")
        else:
            cells[name] = frame[name].to_list()
    rows = np.arange(1, frame.height + 1, dtype=np.int64)
    return Cells(path, rows, cells, left_out=_unread(frame.columns, columns), rules=rules), columns


def write_parquet(frame: pl.DataFrame, path: Path) -> None:
    """Write a table as a Parquet file, atomically."""
    content = io.BytesIO()
    frame.write_parquet(content)
    write_bytes(path, content.getvalue())


def write_table(path: Path, tables: Sequence[Table], columns: Mapping[str, Array | Integers | Sequence[str]]) -> None:
    """Write columns to a Parquet file if ``path`` ends with .parquet, and otherwise to a CSV file with all digits.

    ``columns``: columns of equal length by name. ``tables``: the tables that define their types. NaN becomes an empty cell.
    """
    kinds = {column.name: KINDS[column.kind] for table in tables for column in table.columns}
    series = [pl.Series(name, column, dtype=kinds[name]) for name, column in columns.items()]
    frame = pl.DataFrame([s.fill_nan(None) if s.dtype.is_float() else s for s in series])
    if path.suffix == ".parquet":
        write_parquet(frame, path)
    else:
        write_text(path, frame.write_csv())
