"""Checks that all readers of logs apply to the rows of their files.

Each check raises an InputError that names the invalid row. If the data can be corrected, it adds a warning instead. In this module
``rows`` (N,) are the row numbers in the file ``source``, and ``warnings`` is a list that warnings are appended to.
"""

from collections.abc import Hashable, Iterable, Sequence

import numpy as np

from factorgraph_loc.errors import bad_field
from factorgraph_loc.files.columns import SECONDS
from factorgraph_loc.files.row_rules import Fault, RowRules, require_none
from factorgraph_loc.text import Notice, listed, notice
from factors.odometry.model import composed
from factors.se2 import Array, Integers

MAX_LATE_NS = 500_000_000  # ns; maximum delay of a measurement that estimators can process
ROUNDING = 1e-6  # s; tolerance of comparisons of time differences


def require_finite(source: object, rows: Integers, names: Sequence[str], table: Array) -> None:
    """Raise InputError at the first number of ``table`` (N, K) that is NaN or infinite.

    ``names``: names of the K columns. ``rows`` (N,): row numbers in the file ``source`` that the message names.
    """
    require_none(source, rows, not_finite(names, table))


def not_finite(names: Sequence[str], table: Array) -> list[Fault]:
    """Return a :class:`Fault` for each of the columns ``names`` of ``table`` (N, K). It marks NaN and infinity."""
    columns = zip(names, table.T, strict=True)
    return [Fault(name, values, ~np.isfinite(values), "a finite number") for name, values in columns]


def in_order(
    source: object, rows: Integers, t_ns: Integers, warnings: list[Notice], rules: RowRules | None = None
) -> Integers:
    """Return the indices (M,) of the rows to use. Of rows with equal timestamps ``t_ns`` (N,), only the last is used.

    ``rows`` (N,): row numbers in the file ``source``. ``rules``: if given, the error names the setting that sorts rows. If
    rows are dropped, a warning is appended to ``warnings``. Raises InputError if a timestamp precedes the previous one.
    """
    _require_order(source, rows, t_ns, rules)
    keep = np.flatnonzero(np.append(np.diff(t_ns) > 0, True)[: len(t_ns)])
    if dropped := len(t_ns) - len(keep):
        skipped = "{source}: {rows} rows have the timestamp of the row after them and are skipped"
        warnings.append(notice("same_stamp", skipped, source, dropped))
    return keep


def increments_in_order(
    source: object, rows: Integers, t_ns: Integers, moves: Array, warnings: list[Notice], rules: RowRules | None = None
) -> tuple[Integers, Array]:
    """Return the distinct timestamps (M,) [ns] of odometry increments, and the increments (M, 3 or 4).

    ``moves`` (N, 3 or 4): x, y [m] and heading [rad] since the previous row, in the body frame of that row. The
    optional fourth column is the part [s] of this time without odometry. Increments with equal timestamps ``t_ns`` (N,)
    are composed, with a warning in ``warnings``. ``rows`` (N,): row numbers in the file ``source``. ``rules``: if
    given, errors name the key that sorts the rows. Raises InputError if the timestamps decrease.
    """
    _require_order(source, rows, t_ns, rules)
    last, out = composed(t_ns, moves[:, :3])
    sums = [
        np.bincount(np.searchsorted(t_ns[last], t_ns), weights=column, minlength=len(last)) for column in moves.T[3:]
    ]
    out = np.column_stack((out, *sums))
    if joined := len(t_ns) - len(last):
        sentence = "{source}: {rows} increments have the timestamp of the row before them and are composed with it"
        warnings.append(notice("composed_increments", sentence, source, joined))
    return t_ns[last], out


def _require_order(source: object, rows: Integers, t_ns: Integers, rules: RowRules | None) -> None:
    """Raise InputError if timestamps ``t_ns`` (N,) decrease. ``rows`` (N,): row numbers in the file ``source``."""
    back = np.flatnonzero(np.diff(t_ns) < 0) + 1
    if len(back):
        i = int(back[0])
        expected = f"a timestamp not before that of the previous row, {int(t_ns[i - 1])} ns{_remedy(rules)}"
        raise bad_field(source, "time", f"{int(t_ns[i])} ns", expected, row=int(rows[i]))


def _remedy(rules: RowRules | None) -> str:
    """Return the end of an error message, which names the key that sorts rows. Return "" if ``rules`` is None."""
    return "" if rules is None else rules.sorting


def arrivals(
    source: object,
    rows: Integers,
    t_ns: Integers,
    warnings: list[Notice],
    rules: RowRules | None = None,
    *,
    max_late_ns: int | None = MAX_LATE_NS,
) -> None:
    """Check that no timestamp in ``t_ns`` (N,) [ns] is older than a previous one by more than ``max_late_ns`` [ns].

    If a timestamp is older by a shorter time, a warning is appended to ``warnings``. ``max_late_ns`` None: any order is
    valid. ``rows`` (N,): row numbers in ``source``. ``rules``: if given, errors name the key that sorts the rows.
    Raises InputError if the check fails.
    """
    newest = np.maximum.accumulate(t_ns) if len(t_ns) else t_ns
    late = newest - t_ns
    if max_late_ns is not None and np.any(late > max_late_ns):
        i = int(np.argmax(late > max_late_ns))
        expected = f"a timestamp at most 0.5 s older than that of an earlier row, {int(newest[i])} ns{_remedy(rules)}"
        raise bad_field(source, "time", f"{int(t_ns[i])} ns", expected, row=int(rows[i]))
    if count := int(np.count_nonzero(late)):
        sentence = "{source}: {rows} rows are late, by at most {delay:.3f} s"
        warnings.append(notice("late_rows", sentence, source, count, late.max() * 1e-9))


def unread_columns(source: object, names: Iterable[str]) -> Notice:
    """Return the warning that the columns ``names`` of the file ``source`` are not read."""
    return notice("unread_columns", "{source}: columns that are not read: {columns}", source, listed(names))


def last_in_order(
    source: object,
    rows: Integers,
    t_ns: Integers,
    warnings: list[Notice],
    names: Sequence[str] | None = None,
    rules: RowRules | None = None,
) -> Integers:
    """Return the indices (M,) of the rows to use. Of rows with equal timestamps ``t_ns`` (N,), only the last is used.

    ``names``: the landmark of each row. If given, rows with equal timestamps and different landmarks are all used.
    ``rows`` (N,): row numbers in ``source``. ``rules``: if given, errors name the key that sorts the rows. Unsorted
    rows add a warning to ``warnings``. Raises InputError if a timestamp is over 0.5 s older than a previous one.
    """
    arrivals(source, rows, t_ns, warnings, rules)
    keys: Iterable[Hashable] = t_ns.tolist() if names is None else zip(t_ns.tolist(), names, strict=True)
    last = {key: i for i, key in enumerate(keys)}
    if dropped := len(t_ns) - len(last):
        sentence = "{source}: {rows} rows have the timestamp of a later row and are skipped"
        if names is not None:
            sentence = "{source}: {rows} rows are skipped, because a later row has the same landmark and timestamp"
        warnings.append(notice("same_stamp", sentence, source, dropped))
    return np.array(sorted(last.values()), dtype=np.int64)


def stamps(source: object, rows: Integers, t: Array) -> Integers:
    """Return the timestamps ``t`` (N,) [s] in nanoseconds. Raises InputError at the first that is out of range.

    ``rows`` (N,): row numbers in the file ``source``, which the error names.
    """
    SECONDS.require(source, rows, t, "time")
    return np.asarray(np.rint(t * 1e9).astype(np.int64))


def absolute(t: Array, t0_ns: int) -> Integers:
    """Return timestamps (N,) [ns] for times ``t`` (N,) [s] that count from ``t0_ns`` [ns]."""
    return np.asarray(np.rint(t * 1e9).astype(np.int64) + t0_ns)


def seconds(t_ns: Integers, t0_ns: int) -> Array:
    """Return times (N,) [s] since ``t0_ns`` [ns] for timestamps ``t_ns`` (N,) [ns]."""
    return np.asarray((t_ns - t0_ns) / 1e9, dtype=float)
