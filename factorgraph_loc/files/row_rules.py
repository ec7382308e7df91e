"""The keys of a manifest for rows that are invalid or out of order. Such rows are an error, or they are skipped or
sorted, with a warning that counts them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.models import FileModel
from factorgraph_loc.text import Notice, notice
from factors.se2 import Integers

MOST_SKIPPED = 0.5  # maximum fraction of rows to skip; if more are invalid, a setting such as a unit is wrong


@dataclass(frozen=True)
class Fault:
    """The cells of one field that are invalid for one reason.

    ``field``: the name of the field in errors. ``values``: the N cells of the field. ``wrong`` (N,): True for each
    invalid cell. ``expected``: a description of valid cells.
    """

    field: str
    values: Any
    wrong: NDArray[np.bool_]
    expected: str

    def error(self, source: object, rows: Integers, remedy: str = "") -> InputError:
        """Return the error for the first invalid cell. ``rows`` (N,): row numbers. ``remedy``: end of the message."""
        i = int(self.wrong.argmax())
        value = self.values[i]
        value = value.tolist() if hasattr(value, "tolist") else value
        return bad_field(source, self.field, value, self.expected + remedy, row=int(rows[i]))


class RowRules(FileModel):
    """Settings of a reader: whether invalid rows, and rows out of order, are errors. ``PLACE``: name of the file that
    has these settings, for errors."""

    PLACE: ClassVar[str] = "the manifest"
    bad_rows: Literal["refuse", "skip"] = "refuse"
    """refuse a table with an invalid row, or skip such rows with a warning"""
    order: Literal["refuse", "sort"] = "refuse"
    """refuse a table with rows that are out of order, or sort them by their stamps with a warning"""

    def usable(
        self,
        source: object,
        rows: Integers,
        faults: Sequence[Fault],
        warnings: list[Notice],
        unread: Sequence[tuple[int, str]] = (),
    ) -> Integers:
        """Return the indices (M,) of the rows without a fault. Skipped rows add a warning to ``warnings``.

        ``rows`` (N,): row numbers in the file ``source``. ``faults``: the invalid cells. ``unread``: row number and
        error message of each further row that could not be split into cells. Raises InputError at the first fault if
        ``bad_rows`` is "refuse", or if more than half of all rows are invalid.
        """
        wrong = np.zeros(len(rows), dtype=bool)
        for fault in faults:
            wrong |= fault.wrong
        skipped, count = int(np.count_nonzero(wrong)) + len(unread), len(rows) + len(unread)
        if not skipped:
            return np.arange(len(rows))
        is_few = skipped <= MOST_SKIPPED * count
        if self.bad_rows == "refuse" or not is_few:
            require_none(source, rows, faults, self.skipping if is_few and self.bad_rows == "refuse" else "")
        first = int(wrong.argmax())
        message = min(unread, default=(0, ""))[1]
        if wrong.any() and not (unread and min(unread)[0] < rows[first]):
            message = str(next(fault for fault in faults if fault.wrong[first]).error(source, rows))
        if not is_few:
            raise InputError(message)
        sentence = "{skipped} of {rows} rows are skipped, the first: {message}"
        warnings.append(notice("bad_rows", sentence, skipped, count, message))
        return np.flatnonzero(~wrong)

    def in_time(self, source: object, rows: Integers, t_ns: Integers, warnings: list[Notice]) -> Integers:
        """Return the indices (N,) that sort timestamps ``t_ns`` (N,). They are 0 to N - 1 if ``order`` is "refuse".

        If rows are out of order, a warning is appended to ``warnings``. ``rows`` (N,): row numbers in ``source``.
        """
        late = np.maximum.accumulate(t_ns) - t_ns if len(t_ns) else t_ns
        if self.order == "refuse" or not late.any():
            return np.arange(len(t_ns))
        count, first = int(np.count_nonzero(late)), int(np.argmax(late > 0))
        sentence = (
            "{source}:{row}: the time {t} ns is before the time of an earlier row: {rows} such rows, late by at most "
            "{delay:.3f} s, are sorted"
        )
        warnings.append(notice("sorted_rows", sentence, source, rows[first], t_ns[first], count, late.max() * 1e-9))
        return np.argsort(t_ns, kind="stable")

    @property
    def refuse(self) -> bool:
        """True if both an invalid row and a row out of order are errors."""
        return self.bad_rows == "refuse" and self.order == "refuse"

    @property
    def skipping(self) -> str:
        """The end of an error message: how to set the option that skips invalid rows."""
        return f'; bad_rows = "skip" in {self.PLACE} skips such rows'

    @property
    def sorting(self) -> str:
        """The end of an error message: how to set the option that sorts rows by time."""
        return f'; order = "sort" in {self.PLACE} sorts the rows'


def require_read(unread: Sequence[tuple[int, str]], count: int, rules: RowRules | None) -> None:
    """Raise InputError if rows of a file could not be split into cells, unless ``rules.bad_rows`` is "skip".

    ``unread``: number and error message of each such row. ``count``: number of rows. If more than half of all rows are
    unread, the error is raised in any case.
    """
    if not unread:
        return
    is_few = len(unread) <= MOST_SKIPPED * count
    if rules is None or rules.bad_rows == "refuse" or not is_few:
        can_skip = rules is not None and rules.bad_rows == "refuse" and is_few
        raise InputError(unread[0][1] + (rules.skipping if rules is not None and can_skip else ""))


def require_none(source: object, rows: Integers, faults: Sequence[Fault], remedy: str = "") -> None:
    """Raise InputError at the first invalid cell of ``faults``. ``rows`` (N,): row numbers in the file ``source``.
    ``remedy``: the end of the message."""
    for fault in faults:
        if fault.wrong.any():
            raise fault.error(source, rows, remedy)
