"""Finds and removes jumps of odometry: single rows with an impossible change of the speed or turn rate.

The usual cause is an angle that wraps inside the robot's software. A row is only compared with earlier rows, because
causal estimates must not depend on later rows.
"""

from typing import NamedTuple, TypeVar

import numpy as np

from factorgraph_loc.files.row_rules import RowRules
from factorgraph_loc.model.measurement import selected
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream, YawRateStream
from factorgraph_loc.text import Notice, notice
from factors.se2 import Array, Integers

# in a jump, the rate differs from the median of the previous rows by more than this [rad/s, m/s], and is FACTOR times it
LEAST_TURN, LEAST_SPEED = 6.0, 5.0
FACTOR = 5.0
HELD = 0.1  # s; assumed duration of the first increment, which is usually zero
PREVIOUS = 3  # a row is compared with this many previous rows


Motion = VelocityStream | IncrementStream | YawRateStream
M = TypeVar("M", bound=VelocityStream | IncrementStream | YawRateStream)


class Jump(NamedTuple):
    """A jump in one row of odometry.

    ``row``: the index of the row. ``what``: "speed" or "turn rate". ``unit``: the unit of the rates. ``rate``: the
    speed or turn rate of the row. ``previous``, ``following``: the rates of the rows before and after it.
    """

    row: int
    what: str
    unit: str
    rate: float
    previous: float
    following: float


def jumps(stream: Motion) -> list[Jump]:
    """Return the jumps in odometry or in the turn rates of a gyro, in the order of rows. A jump is a change of the
    speed or turn rate between rows that is larger than a robot can accelerate."""
    if not len(stream.t):
        return []
    if isinstance(stream, YawRateStream):
        speeds, turns = np.zeros(len(stream.t)), stream.w
    elif isinstance(stream, VelocityStream):
        speeds, turns = stream.v, stream.w
    else:
        steps = np.diff(stream.t, prepend=stream.t[0] - HELD)
        steps = np.maximum(
            steps, _previous_medians(steps, HELD)
        )  # timestamps that are too close must not look like high speed
        speeds, turns = np.hypot(stream.dx, stream.dy) / steps, stream.dtheta / steps
    kinds = (("turn rate", "rad/s", turns, LEAST_TURN), ("speed", "m/s", speeds, LEAST_SPEED))
    out = [
        Jump(i, what, unit, *(float(rates[k]) for k in (i, max(i - 1, 0), min(i + 1, len(rates) - 1))))
        for what, unit, rates, least in kinds
        for i in _outliers(rates, least).tolist()
    ]
    return sorted(out)


def _outliers(rates: Array, least: float) -> Integers:
    """Return the indices of ``rates`` (N,) that are outliers. An outlier is more than FACTOR times the median of the
    previous rates, and differs from this median by more than ``least``."""
    usual = _previous_medians(rates, 0.0)
    return np.flatnonzero((np.abs(rates - usual) > least) & (np.abs(rates) > FACTOR * np.abs(usual)))


def _previous_medians(values: Array, first: float) -> Array:
    """Return the median (N,) of the :data:`PREVIOUS` values before each of ``values`` (N,). ``first``: the value that
    is assumed before the first one."""
    padded = np.concatenate((np.full(PREVIOUS, np.nan), values[:-1]))
    padded[PREVIOUS - 1] = first
    windows = np.lib.stride_tricks.sliding_window_view(padded, PREVIOUS)
    return np.asarray(np.nanmedian(windows, axis=1))


def jump_warning(kind: str, events: list[Jump], stream: Motion, end: str) -> Notice:
    """Return a warning about the jumps ``events`` in a stream. ``kind``: the identifier of the warning. ``end``: a text
    that is appended to the warning."""
    first = events[0]
    sentence = (
        "the {what} of the {source} jumps to {rate:.1f} {unit} at t = {t:.3f} s, between rows with {previous:.2f} and "
        f"{{following:.2f}} {{unit}} (such rows: {{rows}}){end}"
    )
    rows = len({jump.row for jump in events})
    t = float(stream.t[first.row])
    source = "gyro" if isinstance(stream, YawRateStream) else "odometry"
    return notice(kind, sentence, first.what, source, first.rate, first.unit, t, first.previous, first.following, rows)


def without_jumps(stream: M, rules: RowRules, warnings: list[Notice]) -> M:
    """Return the stream without the rows that have jumps, and append a warning about them to ``warnings``.

    ``rules``: the log's rules for bad rows. If they refuse bad rows instead of skipping them, the stream is returned
    unchanged. After a removed increment, the next row has the duration of the lost motion in its field ``unknown`` [s].
    """
    if rules.bad_rows == "refuse" or not (events := jumps(stream)):
        return stream
    warnings.append(jump_warning("skipped_jumps", events, stream, ": skipped"))
    keep = np.ones(len(stream.t), dtype=bool)
    keep[[jump.row for jump in events]] = False
    kept = selected(stream, keep)
    if isinstance(kept, IncrementStream):
        rows = np.flatnonzero(keep)
        kept.unknown[:] = np.where(np.diff(rows, prepend=-1) > 1, np.diff(kept.t, prepend=kept.t[0]), kept.unknown)
    return kept
