"""Cells of a CSV with a header."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import Column
from factorgraph_loc.files.models import nearest, read_text
from factorgraph_loc.text import told
from factors.se2 import Array

Shape = tuple[str, ...]  # the names of columns


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
        try:
            values = np.array([float(cell) if cell else np.nan for cell in cells])
        except ValueError:
            i = next(i for i, cell in enumerate(cells) if cell and not _is_number(cell))
            raise bad_field(self.path, name, cells[i], "a number", row=self.rows[i]) from None
        if written := [i for i in np.flatnonzero(~np.isfinite(values)).tolist() if cells[i]]:
            raise bad_field(self.path, name, cells[written[0]], "a finite number", row=self.rows[written[0]])
        told, factor = column.in_unit(unit)
        if not column.may_lack and "" in cells:
            raise bad_field(self.path, name, "", told.expected, row=self.rows[list(cells).index("")])
        told.require(self.path, self.rows, values, name)
        return values if factor == 1.0 else values * factor


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


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
