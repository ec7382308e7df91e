"""Checks that all readers apply to their rows: an InputError with the row, or a warning if the data can be corrected."""

from collections.abc import Hashable, Iterable, Sequence

import numpy as np

from factorgraph_loc.errors import bad_field, require
from factorgraph_loc.files.columns import SECONDS
from factorgraph_loc.text import Notice, listed, notice
from factors.odometry.model import composed
from factors.se2 import Array, Integers

MAX_LATE_NS = 500_000_000  # the delay that estimators can handle
ROUNDING = 1e-6  # s; tolerance of differences of timestamps


def require_finite(source: object, rows: Integers, names: Sequence[str], table: Array) -> None:
    """InputError at a number of ``table`` (N, K) that is NaN or infinite; ``rows`` (N,): row numbers in ``source``; ``names``: of
    the K columns."""
    for name, values in zip(names, table.T, strict=True):
        require(np.isfinite(values), source, rows, name, values, "a finite number")


def in_order(source: object, rows: Integers, t_ns: Integers, warnings: list[Notice]) -> Integers:
    """Indices (M,) of the rows to keep of a stream with non-decreasing timestamps (N,): the last one of equal timestamps."""
    _require_order(source, rows, t_ns)
    keep = np.flatnonzero(np.append(np.diff(t_ns) > 0, True)[: len(t_ns)])
    if dropped := len(t_ns) - len(keep):
        skipped = "{source}: {rows} rows have the timestamp of the row after them and are skipped"
        warnings.append(notice("same_stamp", skipped, source, dropped))
    return keep


def increments_in_order(
    source: object, rows: Integers, t_ns: Integers, moves: Array, warnings: list[Notice]
) -> tuple[Integers, Array]:
    """Timestamps (M,) and motions (M, 3) since the one before: ``moves`` (N, 3) with equal timestamps (N,) are composed."""
    _require_order(source, rows, t_ns)
    last, out = composed(t_ns, moves)
    if joined := len(t_ns) - len(last):
        sentence = "{source}: {rows} increments have the timestamp of the row before them and are composed with it"
        warnings.append(notice("composed_increments", sentence, source, joined))
    return t_ns[last], out


def _require_order(source: object, rows: Integers, t_ns: Integers) -> None:
    """InputError at the first row whose timestamp is older than the one before it."""
    back = np.flatnonzero(np.diff(t_ns) < 0) + 1
    if len(back):
        i = int(back[0])
        expected = f"a timestamp not before that of the row before, {int(t_ns[i - 1])} ns"
        raise bad_field(source, "time", f"{int(t_ns[i])} ns", expected, row=int(rows[i]))


def arrivals(
    source: object, rows: Integers, t_ns: Integers, warnings: list[Notice], *, max_late_ns: int | None = MAX_LATE_NS
) -> None:
    """Check timestamps (N,) in order of arrival: one older than an earlier one is late, and an InputError above ``max_late_ns``."""
    newest = np.maximum.accumulate(t_ns) if len(t_ns) else t_ns
    late = newest - t_ns
    if max_late_ns is not None and np.any(late > max_late_ns):
        i = int(np.argmax(late > max_late_ns))
        expected = f"a timestamp at most 0.5 s older than the newest before it, {int(newest[i])} ns"
        raise bad_field(source, "time", f"{int(t_ns[i])} ns", expected, row=int(rows[i]))
    if count := int(np.count_nonzero(late)):
        sentence = "{source}: {rows} rows are late, by at most {delay:.3f} s"
        warnings.append(notice("late_rows", sentence, source, count, late.max() * 1e-9))


def unread_columns(source: object, names: Iterable[str]) -> Notice:
    """The warning about columns that no option reads."""
    return notice("unread_columns", "{source}: columns that are not read: {columns}", source, listed(names))


def last_in_order(
    source: object, rows: Integers, t_ns: Integers, warnings: list[Notice], names: Sequence[str] | None = None
) -> Integers:
    """Indices (M,) of the rows to keep, in order of arrival: the last row of equal timestamps (N,), and of equal ``names`` if
    given.
    """
    arrivals(source, rows, t_ns, warnings)
    keys: Iterable[Hashable] = t_ns.tolist() if names is None else zip(t_ns.tolist(), names, strict=True)
    last = {key: i for i, key in enumerate(keys)}
    if dropped := len(t_ns) - len(last):
        sentence = "{source}: {rows} rows have the timestamp of a later row and are skipped"
        if names is not None:
            sentence = "{source}: {rows} rows see a landmark that a later row sees at the same timestamp: skipped"
        warnings.append(notice("same_stamp", sentence, source, dropped))
    return np.array(sorted(last.values()), dtype=np.int64)


def stamps(source: object, rows: Integers, t: Array) -> Integers:
    """Timestamps (N,) [s] in nanoseconds; InputError beyond 64 bits."""
    SECONDS.require(source, rows, t, "time")
    return np.asarray(np.rint(t * 1e9).astype(np.int64))


def absolute(t: Array, t0_ns: int) -> Integers:
    """Times (N,) in seconds after ``t0_ns`` as timestamps in nanoseconds."""
    return np.asarray(np.rint(t * 1e9).astype(np.int64) + t0_ns)


def seconds(t_ns: Integers, t0_ns: int) -> Array:
    """Timestamps (N,) in nanoseconds as seconds after ``t0_ns``."""
    return np.asarray((t_ns - t0_ns) / 1e9, dtype=float)
