"""Finds and removes jumps of odometry: single rows with a speed or turn rate that no robot can reach after the rows
before.

The usual cause is an angle that wraps inside the robot's software. Later rows have no influence, so that an estimate at
a time depends on earlier rows only.
"""

from typing import NamedTuple, TypeVar

import numpy as np

from factorgraph_loc.files.row_rules import RowRules
from factorgraph_loc.model.measurement import selected
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream, YawRateStream
from factorgraph_loc.text import Notice, notice
from factors.se2 import Array, Integers

# a jump differs from the median of the rows before by LEAST_TURN [rad/s] or LEAST_SPEED [m/s], and is FACTOR times as large
LEAST_TURN, LEAST_SPEED = 6.0, 5.0
FACTOR = 5.0
HELD = 0.1  # s; assumed duration of the first increment, which is usually zero
PREVIOUS = 3  # number of rows before a row that it is compared with


Motion = VelocityStream | IncrementStream | YawRateStream
M = TypeVar("M", bound=VelocityStream | IncrementStream | YawRateStream)


class Jump(NamedTuple):
    """A jump in one row of odometry.

    ``row``: the number of the row, from 0. ``what``: "speed" or "turn rate". ``unit``: the unit of the rates. ``rate``:
    the speed or turn rate of the row. ``previous``, ``following``: the rates of the rows before and after it.
    """

    row: int
    what: str
    unit: str
    rate: float
    previous: float
    following: float


def jumps(stream: Motion) -> list[Jump]:
    """Return the jumps of a stream of odometry or of a gyro in order of its rows. In a jump the speed or turn rate
    differs from that of the rows before by more than a robot can accelerate."""
    if not len(stream.t):
        return []
    if isinstance(stream, YawRateStream):
        speeds, turns = np.zeros(len(stream.t)), stream.w
    elif isinstance(stream, VelocityStream):
        speeds, turns = stream.v, stream.w
    else:
        steps = np.diff(stream.t, prepend=stream.t[0] - HELD)
        steps = np.maximum(steps, _usual(steps, HELD))  # two timestamps may be close by chance, which is no high speed
        speeds, turns = np.hypot(stream.dx, stream.dy) / steps, stream.dtheta / steps
    kinds = (("turn rate", "rad/s", turns, LEAST_TURN), ("speed", "m/s", speeds, LEAST_SPEED))
    out = [
        Jump(i, what, unit, *(float(rates[k]) for k in (i, max(i - 1, 0), min(i + 1, len(rates) - 1))))
        for what, unit, rates, least in kinds
        for i in _outliers(rates, least).tolist()
    ]
    return sorted(out)


def _outliers(rates: Array, least: float) -> Integers:
    """Return the indices of ``rates`` (N,) that differ from the median of the rates before by more than ``least``, and
    that are more than FACTOR times as large as this median."""
    usual = _usual(rates, 0.0)
    return np.flatnonzero((np.abs(rates - usual) > least) & (np.abs(rates) > FACTOR * np.abs(usual)))


def _usual(values: Array, first: float) -> Array:
    """Return the median (N,) of the :data:`PREVIOUS` values before each of ``values`` (N,). ``first``: the value that
    stands before all others."""
    padded = np.concatenate((np.full(PREVIOUS, np.nan), values[:-1]))
    padded[PREVIOUS - 1] = first
    windows = np.lib.stride_tricks.sliding_window_view(padded, PREVIOUS)
    return np.asarray(np.nanmedian(windows, axis=1))


def jump_warning(kind: str, events: list[Jump], stream: Motion, end: str) -> Notice:
    """Return a warning about the jumps ``events`` in a stream. ``kind``: the kind of the warning. ``end``: text that is
    appended to it."""
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
    """Return the odometry, or the turn rates of a gyro, without jumps, and append a warning about them to ``warnings``.
    If ``rules``, the rules for bad rows of the log, do not skip bad rows, the stream is returned unchanged.

    The velocity before a removed row is valid until the next row. The motion of a removed increment is marked as unknown.
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
