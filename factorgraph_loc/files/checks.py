"""What every reader checks of its rows. What cannot be mended is an InputError with its row, the rest a line of warning."""

from collections.abc import Sequence

import numpy as np

from factorgraph_loc.errors import bad_field
from factorgraph_loc.files.columns import SECONDS
from factors.odometry.model import composed
from factors.se2 import Array, Integers

MAX_LATE_NS = 500_000_000  # what estimators still put in at its time
ROUNDING = 1e-6  # s, by which a difference of stamps may be too long


def require_finite(source: object, rows: Integers, field: str, values: Array) -> None:
    """InputError at the first of ``values`` (N,) that is NaN or infinite; ``rows`` (N,): their rows in ``source``."""
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise bad_field(source, field, float(values[bad[0]]), "a finite number", row=int(rows[bad[0]]))


def require_above_zero(source: object, rows: Integers, field: str, values: Array) -> None:
    """InputError at the first of ``values`` (N,) that is not above zero; NaN, not measured, passes."""
    bad = np.flatnonzero(values <= 0.0)
    if len(bad):
        raise bad_field(source, field, float(values[bad[0]]), "more than 0", row=int(rows[bad[0]]))


def in_order(source: object, rows: Integers, t_ns: Integers, warnings: list[str]) -> Integers:
    """Indices (M,) of the rows to keep of a stream that must not go back in time: of equal stamps (N,) the last."""
    _require_order(source, rows, t_ns)
    keep = np.flatnonzero(np.append(np.diff(t_ns) > 0, True)[: len(t_ns)])
    if dropped := len(t_ns) - len(keep):
        warnings.append(f"{source}: {dropped} rows have the stamp of the row after them and are left out")
    return keep


def increments_in_order(
    source: object, rows: Integers, t_ns: Integers, moves: Array, warnings: list[str]
) -> tuple[Integers, Array]:
    """Stamps (M,) and motions (M, 3) since the one before: ``moves`` (N, 3) of equal stamps (N,) are composed."""
    _require_order(source, rows, t_ns)
    last, out = composed(t_ns, moves)
    if joined := len(t_ns) - len(last):
        warnings.append(f"{source}: {joined} increments have the stamp of the row before them and go on from it")
    return t_ns[last], out


def _require_order(source: object, rows: Integers, t_ns: Integers) -> None:
    """InputError at the first row whose stamp is older than the one before it."""
    back = np.flatnonzero(np.diff(t_ns) < 0) + 1
    if len(back):
        i = int(back[0])
        expected = f"a stamp not before that of the row before, {int(t_ns[i - 1])} ns"
        raise bad_field(source, "time", f"{int(t_ns[i])} ns", expected, row=int(rows[i]))


def arrivals(
    source: object, rows: Integers, t_ns: Integers, warnings: list[str], *, max_late_ns: int | None = MAX_LATE_NS
) -> None:
    """Stamps (N,) in order of arrival: one older than the newest before it is late, by more than ``max_late_ns`` an InputError."""
    newest = np.maximum.accumulate(t_ns) if len(t_ns) else t_ns
    late = newest - t_ns
    if max_late_ns is not None and np.any(late > max_late_ns):
        i = int(np.argmax(late > max_late_ns))
        expected = f"a stamp at most 0.5 s older than the newest before it, {int(newest[i])} ns"
        raise bad_field(source, "time", f"{int(t_ns[i])} ns", expected, row=int(rows[i]))
    if count := int(np.count_nonzero(late)):
        warnings.append(f"{source}: {count} rows are late, by at most {late.max() * 1e-9:.3f} s")


def sightings_in_order(
    source: object, rows: Integers, t_ns: Integers, landmarks: Sequence[str], warnings: list[str]
) -> Integers:
    """Indices (M,) of the sightings to keep, in order of arrival: of one landmark at one stamp the last."""
    arrivals(source, rows, t_ns, warnings)
    last = {key: i for i, key in enumerate(zip(t_ns.tolist(), landmarks, strict=True))}
    if dropped := len(t_ns) - len(last):
        warnings.append(f"{source}: {dropped} rows see a landmark that a later row sees at the same stamp: left out")
    return np.array(sorted(last.values()), dtype=np.int64)


def stamps(source: object, rows: Integers, t: Array, *, per_second: float = 1e9) -> Integers:
    """Stamps (N,) [s] in nanoseconds, in whole steps of which a second has ``per_second``; InputError beyond 64 bits."""
    SECONDS.require(source, rows, t, "time")
    return np.asarray(np.rint(t * per_second).astype(np.int64) * round(1e9 / per_second))


def absolute(t: Array, t0_ns: int) -> Integers:
    """Seconds (N,) after ``t0_ns`` as stamps in nanoseconds."""
    return np.asarray(np.rint(t * 1e9).astype(np.int64) + t0_ns)


def seconds(t_ns: Integers, t0_ns: int) -> Array:
    """Stamps (N,) in nanoseconds as seconds after ``t0_ns``."""
    return np.asarray((t_ns - t0_ns) / 1e9, dtype=float)
