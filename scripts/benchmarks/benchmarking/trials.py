"""Trials of an unknown start and of kidnapping, made from a recorded log by cutting and joining."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log, cut, join
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream
from factors import se2
from factors.se2 import Array

POSITION, HEADING = 0.5, math.radians(15.0)  # m, rad: an estimate with smaller errors is correct
HOLD = 10.0  # s that it must remain correct
LANDMARKS = 3  # number of different landmarks sufficient for localization
START_TIME, RECOVERY_TIME = 60.0, 30.0  # s
BEFORE = 30.0  # s of driving before the kidnapping
JUMP = 0.2  # s between the two parts of a kidnapping
REFERENCE_GAP = 0.1  # s between reference poses that may be interpolated


@dataclass(frozen=True)
class Trial:
    """One trial. ``right``: localized (or recovered) correctly in time; ``false``: the first claim to be localized was wrong
    (after a kidnapping: localized was claimed at the deadline without recovery); ``seconds``: until correct, NaN if never."""

    t: float
    right: bool
    false: bool
    seconds: float


@dataclass(frozen=True)
class TrialJob:
    """``count`` trials of a ``kind`` on a log, for :func:`run_trials`."""

    kind: Literal["unknown start", "kidnapping"]
    log: Log
    estimator: str
    count: int


def run_trials(job: TrialJob) -> list[Trial]:
    """The trials of a job; jobs can be sent to other processes."""
    trials = start_trials if job.kind == "unknown start" else kidnapping_trials
    return trials(job.log, job.estimator, job.count)


def start_trials(log: Log, estimator: str, count: int, settings: Mapping[str, Any] | None = None) -> list[Trial]:
    """Unknown starts at ``count`` times spread evenly over a log with reference, as long as 3 landmarks are still to be seen.

    A start is correct if the estimator is localized within 60 s, or within the time in which it sees 3 different landmarks if
    that is longer, and then stays within 0.5 m and 15 degrees for 10 s.
    """
    first, last = log.span()[0], _last_start(log)
    trials = []
    for i, t in enumerate(first + (last - first) * np.arange(count) / count):
        deadline = max(START_TIME, _third_landmark(log, float(t)) - float(t))
        part = cut(log, float(t), float(t) + deadline + 2.0 * HOLD)
        result = run(part, RunConfig(estimator, settings or {}, prior="unknown", seed=i))
        claimed = np.array(result.status) == "localized"
        good = is_right(result, part)
        first_claim = int(np.argmax(claimed)) if claimed.any() else len(claimed)
        seconds = float(result.t[first_claim] - t) if claimed.any() else math.nan
        right = bool(claimed.any()) and seconds <= deadline and bool(_holds(result.t, good, first_claim))
        wrong = bool(claimed.any()) and not bool(good[first_claim])
        trials.append(Trial(float(t), right, wrong, seconds))
    return trials


def kidnapping_trials(log: Log, estimator: str, count: int, settings: Mapping[str, Any] | None = None) -> list[Trial]:
    """A robot that is kidnapped, ``count`` times, from one time of the log to one half the log later (or earlier).

    It is recovered if it is correct for 10 s, within 30 s of having seen 3 different landmarks at the new place.
    """
    first, last = log.span()
    trials = []
    for i in range(count):
        t = first + BEFORE + (last - first - BEFORE) * i / count
        other = first + (t - first + 0.5 * (last - first)) % (last - first)
        deadline = _third_landmark(log, other) - other + RECOVERY_TIME
        before, after = cut(log, t - BEFORE, t), cut(log, other, other + deadline + 2.0 * HOLD)
        carried = join(before, after, gap=JUMP)
        result = run(carried, RunConfig(estimator, settings or {}, prior="reference", seed=i))
        moved = before.span()[1] + JUMP
        good = is_right(result, carried)
        later = np.flatnonzero(result.t >= moved)
        held = [int(k) for k in later if result.t[k] <= moved + deadline and _holds(result.t, good, int(k))]
        seconds = float(result.t[held[0]] - moved) if held else math.nan
        at_deadline = int(np.searchsorted(result.t, moved + deadline).clip(max=len(result.t) - 1))
        false = not held and result.status[at_deadline] == "localized"
        trials.append(Trial(float(t), bool(held), false, seconds))
    return trials


def _third_landmark(log: Log, t: float) -> float:
    """The time of the third different landmark of the map after ``t``; the log's end if there is none."""
    stream = log.streams["bearing_range"]
    assert isinstance(stream, BearingRangeStream)
    met: set[str] = set()
    for stamp, name in zip(stream.t.tolist(), stream.landmark, strict=True):
        if stamp >= t and name in log.world.landmarks:
            met.add(name)
            if len(met) == LANDMARKS:
                return float(stamp)
    return log.span()[1]


def _last_start(log: Log) -> float:
    """The last time from which 3 different landmarks of the map are still seen; the log's begin if there is none."""
    stream = log.streams["bearing_range"]
    assert isinstance(stream, BearingRangeStream)
    met: set[str] = set()
    for stamp, name in zip(stream.t[::-1].tolist(), stream.landmark[::-1], strict=True):
        if name in log.world.landmarks:
            met.add(name)
            if len(met) == LANDMARKS:
                return float(stamp)
    return log.span()[0]


def is_right(result: RunResult, log: Log) -> np.typing.NDArray[np.bool_]:
    """Which causal estimates are correct; in a gap of the reference, as the one before (at the beginning, the one after)."""
    assert log.reference is not None
    truth = log.reference.at(result.t, max_gap=REFERENCE_GAP)
    error = result.poses - truth
    right = np.hypot(error[:, 0], error[:, 1]) < POSITION
    if log.reference.has_heading:
        right &= ~(np.abs(se2.wrap(error[:, 2])) >= HEADING)
    scored = np.flatnonzero(np.isfinite(truth[:, 0]))
    if not len(scored):
        return right
    return right[scored[np.maximum(np.searchsorted(scored, np.arange(len(right)), side="right") - 1, 0)]]


def _holds(t: Array, right: np.typing.NDArray[np.bool_], first: int) -> bool:
    """Whether all estimates of the following 10 s are correct."""
    during = (t >= t[first]) & (t <= t[first] + HOLD)
    return bool(right[during].all())
