"""Conversion of cells of tables to numbers, names and timestamps."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import LATEST, MAX_SPAN, STAMP, Column, require_span
from factorgraph_loc.files.row_rules import MOST_SKIPPED, Fault, RowRules
from factorgraph_loc.text import Notice, quoted
from factors.se2 import Array, Integers

SECONDS = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # units of time: exponents of ten, in nanoseconds
ISO = "iso"
MOST_DIGITS = 20  # maximum number of digits of a timestamp before its decimal point
NUMBERS, NAMES = ("number", "whole"), ("name", "file")  # kinds of columns
T = TypeVar("T")


@dataclass(frozen=True)
class Cells:
    """The unparsed cells of N rows of a file. A field is the name that this project has for a column, such as ``t_ns``.

    ``rows`` (N,): line numbers in the file ``path``, or row numbers from 1 in a Parquet file.
    ``columns``: the cells of each field: N texts, or an array (N,) of numbers with NaN for empty cells.
    ``labels``: the name of the column in the file, for each field with another name.
    ``units``: the unit of a field in the file: a name, or the factor that converts values to ``Column.unit``.
    ``decimal``: the decimal mark. ``left_out``: names of the columns of the file that are not read.
    ``passed``: number of JSON objects without a needed column. ``unwanted``: number of rows that ``where`` excludes.
    ``rules``: whether invalid rows are skipped, and rows sorted by time. None: invalid rows and decreasing times are errors.
    ``unread``: row number and error message of each row that could not be split into cells.
    ``resumed`` (N,): True for each row that follows a skipped row.
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
    rules: RowRules | None = None
    unread: tuple[tuple[int, str], ...] = ()
    resumed: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __post_init__(self) -> None:
        if len(self.resumed) != len(self.rows):
            object.__setattr__(self, "resumed", np.zeros(len(self.rows), dtype=bool))

    def texts(self, name: str) -> list[str]:
        """Return the N cells of the field ``name`` as texts."""
        return [str(cell) for cell in self.columns[name]]

    def names(self, name: str, column: Column) -> list[str]:
        """Return the N cells of the field ``name``, which are names. Raises InputError at the first empty cell.

        ``column``: the description of the field."""
        texts, faults = self._names(name, column)
        self.require(faults)
        return texts

    def numbers(self, name: str, column: Column) -> Array:
        """Return the numbers (N,) in the field ``name``, converted to ``column.unit``. Empty cells become NaN.

        Raises InputError at the first cell that is no finite number or is out of bounds. Raises InputError also at an
        empty cell if ``column`` forbids it.
        """
        values, faults = self._numbers(name, column)
        self.require(faults)
        return values

    def nanoseconds(self) -> Integers:
        """Return the timestamps (N,) [ns] in the field ``t_ns``. Raises InputError if one is no whole number."""
        return self._of_one_log(self._known(self._nanoseconds()))

    def stamps(self, name: str, offset: float = 0.0) -> Integers:
        """Return the timestamps (N,) [ns] in the field ``name``, plus ``offset`` [s].

        The unit of the field is s, ms, us, ns or iso. The unit iso means a date and time, in UTC if without a time
        zone. Raises InputError for other units, invalid cells, and timestamps that are too far apart.
        """
        return self._of_one_log(self._known(self._stamps(name, offset)))

    def usable(
        self, columns: Mapping[str, Column], warnings: list[Notice], *, offset: float = 0.0, more: Sequence[Fault] = ()
    ) -> "Cells":
        """Return the cells after ``rules`` are applied: without invalid rows, and sorted by timestamp.

        ``columns``: the description of each field, the timestamps first. ``offset`` [s]: is added to the timestamps.
        ``more``: invalid cells that the caller has found in addition. If rows are skipped or sorted, a warning is
        appended to ``warnings``. Raises InputError at an invalid row or decreasing time, unless ``rules`` allow it.
        """
        rules = self.rules
        if rules is None or rules.refuse:
            return self
        kept = self
        if rules.bad_rows == "skip":
            faults = [fault for name, column in columns.items() for fault in self._faults(name, column)]
            kept = self.without([*faults, *more], warnings)
        if rules.order == "sort":
            stamp = next(iter(columns))
            t_ns = kept.nanoseconds() if stamp == STAMP.name else kept.stamps(stamp, offset)
            kept = kept.rows_at(rules.in_time(self.path, kept.rows, t_ns, warnings))
        return kept

    def without(self, faults: Sequence[Fault], warnings: list[Notice]) -> "Cells":
        """Return the cells of the rows that have no invalid cell in ``faults``.

        Raises InputError at the first invalid cell unless ``rules`` skip invalid rows. Then a warning is appended to
        ``warnings``.
        """
        if self.rules is None or self.rules.bad_rows == "refuse":
            self.require(faults)
            return self
        kept = self.rules.usable(self.path, self.rows, faults, warnings, self.unread)
        out = self.rows_at(kept)
        later = np.searchsorted([row for row, _ in self.unread], out.rows)
        return replace(out, resumed=out.resumed | (np.diff(kept, prepend=-1) > 1) | (np.diff(later, prepend=0) > 0))

    def rows_at(self, which: Integers) -> "Cells":
        """Return the cells of the rows with the indices ``which`` (M,), in the order of ``which``."""
        columns = {
            name: cells[which] if isinstance(cells, np.ndarray) else [cells[i] for i in which.tolist()]
            for name, cells in self.columns.items()
        }
        return replace(self, rows=self.rows[which], columns=columns, unread=(), resumed=self.resumed[which])

    def require(self, faults: Sequence[Fault]) -> None:
        """Raise InputError at the first invalid cell of ``faults``."""
        for fault in faults:
            if fault.wrong.any():
                is_few = self.rules is not None and fault.wrong.mean() <= MOST_SKIPPED
                raise fault.error(self.path, self.rows, self.rules.skipping if self.rules and is_few else "")

    def fault(self, name: str, wrong: NDArray[np.bool_], expected: str) -> Fault:
        """Return the invalid cells of the field ``name``. ``wrong`` (N,): mask of them. ``expected``: describes valid cells."""
        return Fault(self.labels.get(name, name), self.columns[name], wrong, expected)

    def _faults(self, name: str, column: Column) -> Sequence[Fault]:
        """Return the invalid cells of a field, one :class:`Fault` per reason. ``column``: describes the field."""
        if column.kind in NAMES:
            return self._names(name, column)[1]
        if column.kind in NUMBERS:
            return self._numbers(name, column)[1]
        t_ns, faults = self._nanoseconds() if name == STAMP.name else self._stamps(name, 0.0)
        away = np.abs(t_ns / 1e9 - np.median(t_ns / 1e9)) > MAX_SPAN if len(t_ns) else np.zeros(0, dtype=bool)
        return *faults, self.fault(name, away, f"a time at most {MAX_SPAN / 86_400.0:g} days from most of the file")

    def _known(self, stamps: tuple[Integers, Sequence[Fault]]) -> Integers:
        """Return the timestamps ``stamps[0]`` [ns]. Raises InputError at the first invalid cell in ``stamps[1]``."""
        self.require(stamps[1])
        return stamps[0]

    def _of_one_log(self, t_ns: Integers) -> Integers:
        """Return the timestamps ``t_ns``. Raises InputError if two of them differ by more than :data:`MAX_SPAN`."""
        try:
            require_span([(self.path, self.rows, t_ns)])
        except InputError as error:
            raise InputError(f"{error}{self.rules.skipping if self.rules is not None else ''}") from error
        return t_ns

    def _names(self, name: str, column: Column) -> tuple[list[str], Sequence[Fault]]:
        texts = self.texts(name)
        return texts, [self.fault(name, np.array([not text for text in texts], dtype=bool), column.doc)]

    def _numbers(self, name: str, column: Column) -> tuple[Array, Sequence[Fault]]:
        cells, faults = self.columns[name], []
        if isinstance(cells, np.ndarray):
            values, is_empty = cells, np.isnan(cells)
        else:
            values, is_empty, wrong = self._floats(cells)
            faults.append(self.fault(name, wrong, "a number"))
            is_empty |= wrong
        in_file, factor = column.in_unit(self.units.get(name, 1.0), self.path)
        faults.append(self.fault(name, ~(np.isfinite(values) | is_empty), "a finite number"))
        expected = in_file.expected + (", or nothing" if column.may_lack else "")
        if not column.may_lack:
            faults.append(self.fault(name, is_empty, in_file.expected))
        outside = Fault(self.labels.get(name, name), values, in_file.outside(values), expected)
        return values if factor == 1.0 else values * factor, [*faults, outside]

    def _nanoseconds(self) -> tuple[Integers, Sequence[Fault]]:
        name = STAMP.name
        stamps, wrong = _converted(self.columns[name], lambda cell: _limited(int(cell)), 0)
        return np.array(stamps, dtype=np.int64), [self.fault(name, wrong, STAMP.expected)]

    def _stamps(self, name: str, offset: float) -> tuple[Integers, Sequence[Fault]]:
        unit = self.units.get(name)
        if unit not in {*SECONDS, ISO}:
            expected = f"one of {', '.join(SECONDS)} or {ISO}"
            raise InputError(f"{self.path}: units.{name} is {quoted(unit)}, expected {expected}")
        power, shift = SECONDS.get(str(unit), 0), round(offset * 1e9)
        expected = f"a number of {unit} in {-LATEST / 10**power:g} to {LATEST / 10**power:g}"
        if unit == ISO:
            expected = "a date and time, 2026-01-31T12:00:00.5Z"

        def stamp(text: str) -> int:
            return _limited(shift + (iso_nanoseconds(text) if unit == ISO else self._scaled(text, power)))

        stamps, wrong = _converted(self.columns[name], stamp, 0)
        return np.array(stamps, dtype=np.int64), [self.fault(name, wrong, expected)]

    def invalid(self, name: str, i: int, expected: str) -> InputError:
        """Return the error for the invalid cell ``i`` of the field ``name``. ``expected``: a description of valid cells."""
        return bad_field(self.path, self.labels.get(name, name), self.columns[name][i], expected, row=int(self.rows[i]))

    def _floats(self, texts: Sequence[Any]) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Return the numbers (N,) in N texts, and masks (N,) of the empty and of the invalid texts.

        The numbers of empty and invalid texts are NaN."""
        if self.decimal == ".":
            with suppress(ValueError):  # the fast case: no text is empty or invalid
                values = np.array(list(map(float, texts)), dtype=float)
                return values, np.zeros(len(texts), dtype=bool), np.zeros(len(texts), dtype=bool)

        def number(text: str) -> float:
            return float(text.replace(self.decimal, ".")) if text else np.nan

        numbers, wrong = _converted(texts, number, np.nan)
        return np.array(numbers, dtype=float), np.array([not text for text in texts], dtype=bool), wrong

    def _scaled(self, text: str, power: int) -> int:
        """Return a decimal number times 10**power, rounded to an integer without floating-point errors.

        Raises ArithmeticError if the text is no finite number or has more than :data:`MOST_DIGITS` digits before the decimal mark.
        """
        text = text.replace(self.decimal, ".")
        whole, _, fraction = text.partition(".")
        if len(whole) <= MOST_DIGITS and len(fraction) <= power and (whole + fraction).isdecimal():
            return int(whole + fraction + "0" * (power - len(fraction)))  # faster than Decimal
        number = Decimal(text)
        if not number.is_finite() or number.adjusted() > MOST_DIGITS:  # 1e999999 has a million digits
            raise OverflowError
        return round(number.scaleb(power))


def _converted(cells: Iterable[Any], convert: Callable[[Any], T], blank: T) -> tuple[list[T], NDArray[np.bool_]]:
    """Return the values (N) of ``convert`` for N cells, and a mask (N,) of the cells for which ``convert`` raises an
    exception. The value of such a cell is ``blank``."""
    out: list[T] = []
    wrong: list[int] = []
    for cell in cells:
        try:
            out.append(convert(cell))
        except (ArithmeticError, TypeError, ValueError):
            wrong.append(len(out))
            out.append(blank)
    mask = np.zeros(len(out), dtype=bool)
    mask[wrong] = True
    return out, mask


def _limited(stamp: int) -> int:
    """Return the timestamp ``stamp`` [ns] unchanged. Raises OverflowError if it exceeds :data:`LATEST`."""
    if abs(stamp) > LATEST:
        raise OverflowError
    return stamp


def iso_nanoseconds(text: str) -> int:
    """Return an ISO 8601 date and time in nanoseconds since 1970. A time without a time zone is UTC.

    Raises ValueError if the text is invalid.
    """
    # the fraction of a second is parsed separately, because datetime has microseconds only
    fraction = re.search(r"[.,](\d+)", text)
    whole = text.replace(fraction.group(0), "", 1) if fraction else text
    moment = datetime.fromisoformat(whole.strip())
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    digits = fraction.group(1) if fraction else ""
    return int(moment.timestamp()) * 10**9 + int((digits + "0" * 9)[:9])
