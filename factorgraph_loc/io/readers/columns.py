"""Text files of numbers in whitespace-separated columns with comments."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import read_text
from factors.se2 import Array, Integers


def read_columns(path: Path, fields: Sequence[str]) -> tuple[Array, Integers]:
    """The finite numbers (N, K) of a file with K ``fields``, and line numbers (N,).

    Blank lines and lines that begin with ``#`` are skipped. InputError names file, row and field of an invalid value; an empty file
    is invalid.
    """
    text = read_text(path)
    if not text.strip():
        raise InputError(f"{path}: is empty, expected rows of {', '.join(fields)}")
    numbered = [
        (row, line)
        for row, line in enumerate(text.split("\n"), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    rows = np.array([row for row, _ in numbered], dtype=np.int64)
    if not numbered:
        return np.empty((0, len(fields))), rows
    try:
        table = np.loadtxt([line for _, line in numbered], dtype=float, comments=None, ndmin=2)
    except ValueError:
        table = None
    if table is None or table.shape[1] != len(fields):
        raise first_fault(path, fields, numbered)
    for i, field in enumerate(fields):
        checks.require_finite(path, rows, field, table[:, i])
    return table, rows


def first_fault(path: Path, fields: Sequence[str], numbered: Sequence[tuple[int, str]]) -> InputError:
    """The error for the first line that does not consist of one number per field."""
    for row, line in numbered:
        parts = line.split()
        if len(parts) != len(fields):
            return bad_field(path, "row", line.strip(), f"{len(fields)} values: {', '.join(fields)}", row=row)
        for field, part in zip(fields, parts, strict=True):
            try:
                float(part)
            except ValueError:
                return bad_field(path, field, part, "a number", row=row)
    return InputError(f"{path}: cannot be read as rows of {', '.join(fields)}")
