"""Checks if odometry, gyro and reference agree in time, sign, unit and scale.

Turn rates are compared at various time shifts. If the reference has no headings, speeds are compared instead.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.model.scoring import TICK_GAP
from factorgraph_loc.sensors import interfaces
from factorgraph_loc.sensors.interfaces import BETTER, FEWEST, LARGE, SHIFTS, SLOWEST, STEP, Paragraph, Summary
from factorgraph_loc.sensors.motion import integrated, odometry_model
from factorgraph_loc.sensors.odometry.jumps import jump_warning, jumps
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream, YawRateStream
from factorgraph_loc.text import Notice, notice
from factors import se2
from factors.se2 import Array

WINDOW = 0.2  # s; minimum time over which a rate is averaged
MOVES = 0.03  # rad/s, m/s; minimum root mean square of the rates for a comparison
ALIKE = 0.6  # minimum correlation of two signals that measure the same motion
DEGREES = (20.0, 150.0)  # ratios of turn rates between these bounds mean that one rate is in degrees
CHORD = 2.0  # s; distances and rotations are compared over time intervals of this length
SCALED = 0.1  # a ratio of reference to odometry that differs from 1 by more than this causes a warning
# a reference stands still if it moves less than STANDS [m] while the odometry drives more than DRIVES [m] in STILL [s]
STANDS, DRIVES = 0.02, 0.5
STILL = 5.0
IN_DEGREES = "{source} turns {ratio:.0f} times as much as {other}: is it in degrees?"
COVERED = 0.9  # a reference should cover at least this fraction of a log's time


@dataclass(frozen=True)
class RateMatch:
    """The relation of two signals of the same motion. ``shift``: the delay [s] of the second signal relative to the
    first. ``slope``: the second signal divided by the first, negative if the signs differ."""

    shift: float
    slope: float


def summarize(log: Log) -> Summary:
    """Return the summary of the odometry in a log: warnings, and ratios of the reference's motion to the odometry."""
    ratios, still = against_reference(log)
    covered = _coverage(log)
    problems = [*motion_problems(log), *still]
    text = [
        Paragraph(f"the reference {what} {ratio:.3f} times as much as the odometry") for what, ratio in ratios.items()
    ]
    entries = {f"odometry.{what}_ratio": ratio for what, ratio in ratios.items()}
    return Summary(found=entries, problems=[*covered, *_jumps(log), *(problems or _doubtful(ratios))], text=text)


def _jumps(log: Log) -> list[Notice]:
    """Return warnings about jumps of the odometry and of the gyro."""
    return [
        jump_warning(f"{name}_jumps", events, stream, '; bad_rows = "skip" skips them')
        for name, stream in log.streams.items()
        if isinstance(stream, VelocityStream | IncrementStream | YawRateStream) and (events := jumps(stream))
    ]


def against_reference(log: Log) -> tuple[dict[str, float], list[Notice]]:
    """Return ratios that compare the reference with the odometry, and a list of warnings.

    The ratios by name: ``travels``, ``turns``: the distance and the rotation of the reference, divided by those of the
    odometry. A ratio is missing if the robot moves too little. The only possible warning is that the reference stands
    still while the odometry drives.
    """
    stream, reference = log.streams.get("odometry"), log.reference
    if reference is None or not isinstance(stream, VelocityStream | IncrementStream) or len(stream.t) < 2:
        return {}, []
    begin, end = _longest(stream.t)
    pause = float(np.median(np.diff(reference.t))) if len(reference.t) > 1 else np.inf
    if pause > SLOWEST or end - begin < STILL:
        return {}, []
    t = np.arange(begin, end, CHORD / 4.0) + log.rig.time_offset("odometry")
    states, poses = integrated(log, odometry_model(log.rig)).states(t), reference.at(t, max_gap=3.0 * pause)
    ratios = {"travels": _ratio(_chords(poses[:, :2], 4), _chords(states[:, 1:3], 4))}
    if reference.has_heading:
        ratios["turns"] = _ratio(se2.wrap(poses[4:, 2] - poses[:-4, 2]), se2.wrap(states[4:, 3] - states[:-4, 3]))
    known = {what: ratio for what, ratio in ratios.items() if ratio is not None}
    return known, _standstill(t, states[:, 1:3], poses[:, :2])


def _ratio(theirs: Array, ours: Array) -> float | None:
    """Return the least-squares ratio of ``theirs`` (N,) to ``ours`` (N,). Returns None if the sum of the squares of
    ``ours`` is at most 1."""
    known = np.isfinite(theirs)
    moved = float(ours[known] @ ours[known])
    return float(ours[known] @ theirs[known]) / moved if moved > 1.0 else None


def _doubtful(ratios: Mapping[str, float]) -> list[Notice]:
    """Return warnings about ``ratios``, from :func:`against_reference`, that are not near 1. Ratios of ``turns`` that
    suggest another sign or unit are skipped, because :func:`motion_problems` warns about them."""
    keys = {"travels": "scale_distance", "turns": "scale_rotation"}
    sentence = "the reference {moves} {ratio:.2f} times as much as the odometry: set odometry.{setting}, or run fgloc calibrate"
    return [
        notice("odometry_scale", sentence, what, ratio, keys[what])
        for what, ratio in ratios.items()
        if abs(ratio - 1.0) > SCALED and (what == "travels" or -0.5 < ratio < 2.0)
    ]


def _standstill(t: Array, ours: Array, theirs: Array) -> list[Notice]:
    """Return a list with a warning if the reference stands still while the odometry drives. ``ours``, ``theirs``
    (N, 2): positions [m] by odometry and by reference at the times ``t`` (N,) [s]."""
    steps = round(STILL / (CHORD / 4.0))
    stuck = np.flatnonzero((_chords(theirs, steps) < STANDS) & (_chords(ours, steps) > DRIVES))
    if not len(stuck):
        return []
    first, far = float(t[stuck[0]]), float(np.max(_chords(ours, steps)[stuck]))
    sentence = "the reference stands still at {t:.1f} s, while the odometry drives {distance:.1f} m in {duration:g} s"
    return [notice("reference_stands", sentence, first, far, STILL)]


def _chords(places: Array, steps: int) -> Array:
    """Return the distances (N - steps,) between positions ``steps`` rows apart. ``places`` (N, 2): the positions."""
    return np.asarray(np.hypot(*(places[steps:] - places[:-steps]).T))


def motion_problems(log: Log) -> list[Notice]:
    """Return warnings if the gyro or the reference seems to have another clock, sign or unit than the odometry. Only
    the longest part of the log without a long gap is compared."""
    stream = log.streams.get("odometry")
    if not isinstance(stream, VelocityStream | IncrementStream) or len(stream.t) < 2:
        return []
    lines = list[Notice]()
    begin, end = _longest(stream.t)
    t = np.arange(begin, end, STEP) + log.rig.time_offset("odometry")
    states = integrated(log, odometry_model(log.rig)).states(t)
    heading, distance = states[:, 3], states[:, 4]
    gyro = log.streams.get("imu")
    if isinstance(gyro, YawRateStream) and len(gyro.t) > 1:
        turned = np.append(0.0, np.cumsum(gyro.w[:-1] * np.diff(gyro.t)))
        angles = np.interp(t, gyro.t + log.rig.time_offset("imu"), turned, left=np.nan, right=np.nan)
        lines += _compared("imu", "the gyro", match(_rates(heading, WINDOW), _rates(angles, WINDOW)))
    reference = log.reference
    pause = np.inf if reference is None or len(reference.t) < 2 else float(np.median(np.diff(reference.t)))
    if reference is None or pause > SLOWEST:
        return lines
    window, poses = max(WINDOW, 2.0 * pause), reference.at(t, max_gap=3.0 * pause)
    if reference.has_heading:
        known = np.isfinite(poses[:, 2])
        angles = np.full(len(t), np.nan)
        angles[known] = np.unwrap(poses[known, 2])
        lines += _compared("odometry", "the reference", match(_rates(heading, window), _rates(angles, window)))
    else:
        agreed = match(_rates(distance, window), _speeds(poses[:, :2], window))
        lines += _compared("odometry", "the reference", agreed and RateMatch(agreed.shift, 1.0))
    return lines


def _longest(t: Array) -> tuple[float, float]:
    """Return the first and the last time [s] of the longest part of ``t`` (N,) without a gap above
    :data:`~factorgraph_loc.model.scoring.TICK_GAP`."""
    parts = np.split(t, np.flatnonzero(np.diff(t) > TICK_GAP) + 1)
    longest = max(parts, key=lambda part: float(part[-1] - part[0]))
    return float(longest[0]), float(longest[-1])


def match(rates: Array, delayed: Array) -> RateMatch | None:
    """Return the delay [s] of ``delayed`` (N,) relative to ``rates`` (N,), and the ratio ``delayed`` / ``rates``.

    Both are sampled every ``STEP`` seconds. Returns None if they are uncorrelated. The delay is 0 if it hardly improves
    the correlation, or if the rates are nearly constant.
    """
    if np.count_nonzero(np.isfinite(rates) & np.isfinite(delayed)) < FEWEST:
        return None
    fits = np.array([_correlation(rates, delayed, int(k)) for k in SHIFTS])
    best, none = int(np.argmax(np.abs(fits[:, 0]))), len(SHIFTS) // 2
    if abs(fits[best, 0]) < ALIKE:
        return None
    left = 1.0 - fits[:, 0] ** 2
    is_observable = np.nanstd(rates) > MOVES and np.nanstd(delayed) > MOVES
    if not is_observable or abs(SHIFTS[best]) * STEP < LARGE or left[best] > BETTER * left[none]:
        best = none
    return RateMatch(float(SHIFTS[best] * STEP), float(fits[best, 1])) if abs(fits[best, 0]) >= ALIKE else None


def _correlation(rates: Array, signal: Array, shift: int) -> tuple[float, float]:
    """Return the correlation and the slope between ``rates`` (N,) and ``signal`` (N,). Row i of ``rates`` is compared
    with row i + ``shift`` of ``signal``. Both results are 0 if the robot hardly moves."""
    a = rates[max(0, -shift) : len(rates) - max(0, shift)]
    b = signal[max(0, shift) : len(signal) - max(0, -shift)]
    both = np.isfinite(a) & np.isfinite(b)
    a, b = a[both], b[both]
    if len(a) < FEWEST or np.sqrt(np.mean(a**2)) < MOVES:
        return 0.0, 0.0
    aa, ab, bb = float(a @ a), float(a @ b), float(b @ b)
    return (ab / np.sqrt(aa * bb), ab / aa) if bb > 0.0 else (0.0, 0.0)


def _compared(sensor: str, name: str, compared: RateMatch | None) -> list[Notice]:
    """Return warnings about a wrong clock, sign or unit of the signal ``name``. ``compared``: its relation to the
    odometry, or None for no warnings. ``sensor``: the section of the rig with the ``time_offset`` to set."""
    if compared is None:
        return []
    lines = []
    if compared.slope < 0.0:
        sentence = "{source} turns in the opposite direction of the odometry: expected counter-clockwise angles, seen from above"
        lines.append(notice("opposite_turns", sentence, name))
    size = abs(compared.slope)
    if DEGREES[0] < size < DEGREES[1]:
        lines.append(notice("degrees", IN_DEGREES, name, size, "the odometry"))
    elif DEGREES[0] < 1.0 / size < DEGREES[1]:
        lines.append(notice("degrees", IN_DEGREES, "the odometry", 1.0 / size, name))
    if compared.shift:
        # time_offset is added to timestamps: it is negative for a late gyro, positive for odometry before the reference
        offset = -compared.shift if sensor == "imu" else compared.shift
        lines.append(interfaces.line(name, compared.shift, "the odometry", sensor, offset))
    return lines


def _rates(values: Array, window: float) -> Array:
    """Return the rates of change (N,) of ``values`` (N,), averaged over a ``window`` [s] around each time. The first
    and last rates are NaN."""
    half = max(1, round(window / STEP / 2.0))
    out = np.full(len(values), np.nan)
    if len(values) > 2 * half:
        out[half:-half] = (values[2 * half :] - values[: -2 * half]) / (2 * half * STEP)
    return out


def _speeds(places: Array, window: float) -> Array:
    """Return the speeds (N,) of positions (N, 2), averaged over a ``window`` [s] around each time."""
    return np.asarray(np.hypot(_rates(places[:, 0], window), _rates(places[:, 1], window)))


def _coverage(log: Log) -> list[Notice]:
    stream = log.streams.get("odometry")
    if log.reference is None or stream is None or len(stream.t) < 2:
        return []
    first, last = float(stream.t[0]), float(stream.t[-1])
    begin, end = max(first, float(log.reference.t[0])), min(last, float(log.reference.t[-1]))
    if end - begin >= COVERED * (last - first):
        return []
    if end <= begin:
        return [notice("no_overlap", "the reference trajectory and the odometry do not overlap in time")]
    sentence = "the reference covers {begin:.1f} to {end:.1f} s of the odometry's {first:.1f} to {last:.1f} s"
    return [notice("short_reference", sentence, begin, end, first, last)]
