"""The cells of a table, and their conversion to numbers, names and timestamps."""

import csv
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import LATEST, STAMP, Column, require_span
from factorgraph_loc.text import quoted, told
from factors.se2 import Array, Integers

SECONDS = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # powers of ten of a nanosecond
ISO = "iso"
MOST_DIGITS = 20  # of a timestamp before its decimal point
NUMBERS, NAMES = ("number", "whole"), ("name", "file")  # kinds of columns
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
            values = np.array(self._converted(name, self._number, "a number"), dtype=float)
            is_empty = np.array([not cell for cell in cells], dtype=bool)
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

    def _number(self, text: str) -> float:
        return float(text.replace(self.decimal, ".")) if text else np.nan

    def _scaled(self, text: str, power: int) -> int:
        """A decimal number times ten to the ``power``, rounded, without floating-point errors."""
        number = Decimal(text.replace(self.decimal, "."))
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
        raise InputError(f"{path}:{lines[reader.line_num - 1][0]}: is not CSV: {told(error)}") from error


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
