"""Checks of whole logs: bounds of values, the time span, and warnings.

A reader checks the values that it can attribute to a row of a file. This module also checks values that a reader
computes from several rows, or converts from foreign formats.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.checks import ROUNDING
from factorgraph_loc.files.columns import MAX_SPAN, POSES, Column, find_outlier
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.sections import kind_of
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream
from factorgraph_loc.sensors.registry import channel, channels
from factorgraph_loc.sensors.tables import columns_of
from factorgraph_loc.text import Notice, listed, notice
from factors.se2 import Array

TURNED = 2.0  # rad; if the odometry turns by more, constant headings of a reference are invalid
LONG_GAP = 5.0  # s between successive timestamps above which a gap is reported
TOLERANCE = 1e-9  # relative tolerance for converted values


def require_bounds(log: Log) -> None:
    """Raise InputError, with the time, at the first measured value of a log that is outside of its allowed bounds."""
    for name, stream in log.streams.items():
        for column in columns_of(channel(name), stream) if kind_of(name) in channels() else ():
            _require(f"{log.name}: {name}", column, stream.t, getattr(stream, column.name))
    if log.reference is not None:
        known = ("x", "y", "heading") if log.reference.has_heading else ("x", "y")
        for name, values in zip(known, log.reference.poses.T, strict=False):
            _require(f"{log.name}: reference", POSES[name], log.reference.t, values)
    if log.start is not None:
        for name, value in zip(("x", "y", "heading"), log.start.pose, strict=True):
            _require(f"{log.name}: start", POSES[name], np.array((log.start.t,)), np.array((value,)))


def _require(where: str, column: Column, t: Array, values: Array) -> None:
    """Raise InputError at the first of ``values`` (N,) that is outside of the bounds of ``column`` by more than rounding.

    ``where``: the beginning of the error. ``t`` (N,): the times of the values [s]."""
    low, high = column.low - TOLERANCE * abs(column.low), column.high + TOLERANCE * abs(column.high)
    bad = replace(column, low=low, high=high).outside(values)
    if bad.any():
        i = int(np.argmax(bad))
        raise InputError(f"{where} at {t[i]:.3f} s: {column.name} is {float(values[i])!r}, expected {column.expected}")


def require_one_span(log: Log) -> None:
    """Raise InputError if two timestamps of a log differ by more than :data:`MAX_SPAN`.

    The timestamps are those of all measurements and of the known start pose."""
    filled = {name: stream.t for name, stream in log.streams.items() if len(stream.t)}
    if not filled:
        return
    for name, t in filled.items():
        if not np.all(np.isfinite(t)):
            raise InputError(f"{log.name}: {name} has a timestamp that is not a finite number")
    first, last = log.span()
    expected = f"one at most {MAX_SPAN / 86_400.0:g} days from all others of the log"
    if outlier := find_outlier(list(filled.values()), MAX_SPAN):
        table, i, middle = outlier
        name, t = list(filled.items())[table]
        where = f"{log.name}: row {i + 1} of {name} has a timestamp {t[i] - middle:+.0f} s from the median timestamp"
        raise InputError(f"{where}, expected {expected}: check the clock of {name}")
    if log.start is not None and not last - MAX_SPAN <= log.start.t <= first + MAX_SPAN:
        raise InputError(
            f"{log.name}: the start pose is {log.start.t:.0f} s after the first timestamp, expected {expected}"
        )


def long_gaps(t: Array) -> tuple[tuple[float, float], ...]:
    """Return (start, length) [s] of each gap above :data:`LONG_GAP` between ascending timestamps ``t`` (N,) [s]."""
    steps = np.diff(t)
    return tuple((float(t[i]), float(steps[i])) for i in np.flatnonzero(steps > LONG_GAP + ROUNDING))


def gap_warnings(name: str, gaps: Sequence[tuple[float, float]]) -> list[Notice]:
    """Return a list with a warning about the ``gaps`` (start, length) [s] of the stream ``name``, if there are any."""
    if not gaps:
        return []
    start, length = max(gaps, key=lambda gap: gap[1])
    count = "a gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
    sentence = "{stream}: {gaps} above {limit:g} s, the longest {length:.1f} s at t = {start:.3f} s"
    return [notice("gaps", sentence, name, count, LONG_GAP, length, start)]


def without_false_headings(log: Log) -> Log:
    """Return the log, without the headings of its reference trajectory if they never change although the robot turns.

    The robot turns if the odometry turns by more than :data:`TURNED`. Systems that measure only positions may report a
    constant orientation.
    """
    stream, reference = log.streams.get("odometry"), log.reference
    if reference is None or not reference.has_heading or len(reference.t) < 2 or np.ptp(reference.poses[:, 2]) > 1e-9:
        return log
    if stream is None or len(stream.t) < 2:
        return log
    if isinstance(stream, IncrementStream):
        turned = float(np.ptp(np.cumsum(stream.dtheta)))
    elif isinstance(stream, VelocityStream):
        turned = float(np.ptp(np.cumsum(stream.w[:-1] * np.diff(stream.t))))
    else:
        return log
    if turned <= TURNED:
        return log
    sentence = "the reference never turns, while the odometry turns by {turned:.0f} rad: its headings are ignored"
    warning = notice("false_headings", sentence, turned)
    return replace(log, reference=replace(reference, has_heading=False), warnings=(*log.warnings, warning))


def log_warnings(log: Log) -> list[Notice]:
    """Return warnings about gaps in odometry, measurements before it, and observed landmarks that the map lacks.

    Raises InputError if the log has measurements but no odometry.
    """
    odometry = log.streams.get("odometry")
    if odometry is None and log.reference is not None and not log.streams:
        return []
    if odometry is None or len(odometry.t) == 0:
        raise InputError(f"{log.name}: has no odometry, which every estimator needs")
    warnings = gap_warnings("odometry", long_gaps(odometry.t))
    for name, stream in log.streams.items():
        if name != "odometry" and (early := int(np.count_nonzero(stream.t < odometry.t[0]))):
            warnings.append(notice("early_rows", "{stream}: {rows} rows come before the first odometry", name, early))
    for name, stream in log.streams.items():
        if isinstance(stream, BearingRangeStream):
            unknown = [landmark for landmark in stream.landmark if landmark not in log.world.landmarks]
            if unknown:
                names = listed(sorted(set(unknown)))
                sentence = "{stream}: {rows} rows name landmarks that the map lacks: {landmarks}"
                warnings.append(notice("unknown_landmarks", sentence, name, len(unknown), names))
    return warnings
