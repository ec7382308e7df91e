"""Trials of an unknown start and of kidnapping on a recorded log. A kidnapping is simulated by joining two parts of the log."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log, cut, join
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream
from factors import se2
from factors.se2 import Array

POSITION, HEADING = 0.5, math.radians(15.0)  # m, rad: an estimate with smaller errors is correct
HOLD = 10.0  # s for which an estimate must remain correct
LANDMARKS = 3  # number of different landmarks that are sufficient for localization
START_TIME, RECOVERY_TIME = 60.0, 30.0  # s: deadlines
BEFORE = 30.0  # s of driving before the kidnapping
JUMP = 0.2  # s between the two joined parts of the log
REFERENCE_GAP = 0.1  # s between reference poses that may be interpolated


@dataclass(frozen=True)
class Trial:
    """The result of one trial.

    ``t`` [s]: the time of the start or of the kidnapping. ``right``: True if the robot was correctly localized in time.
    ``false``: True if the first estimate with the status localized was wrong. After a kidnapping: True if the status was
    localized at the deadline, and the robot had not recovered. ``seconds`` [s]: the time until the estimate was correct, NaN if
    it never was.
    """

    t: float
    right: bool
    false: bool
    seconds: float


def start_trials(log: Log, estimator: str, count: int) -> list[Trial]:
    """Start an estimator with an unknown pose at ``count`` times, distributed evenly over a log with a reference.

    After each start, 3 different landmarks are still measured. A start is correct if the estimator is localized within 60 s, or
    until 3 different landmarks were measured, if that takes longer. Its error must then be below 0.5 m and 15 degrees for 10 s.
    """
    stamps, names = _sightings(log)
    first, last = log.span()[0], _third(stamps[::-1], names[::-1], log.span()[0])
    trials = []
    for i, t in enumerate(first + (last - first) * np.arange(count) / count):
        later = stamps >= t
        deadline = max(START_TIME, _third(stamps[later], names[later], log.span()[1]) - float(t))
        part = cut(log, float(t), float(t) + deadline + 2.0 * HOLD)
        result = run(part, RunConfig(estimator, prior="unknown", seed=i))
        claimed = np.array(result.status) == "localized"
        good = is_right(result, part)
        first_claim = int(np.argmax(claimed)) if claimed.any() else len(claimed)
        seconds = float(result.t[first_claim] - t) if claimed.any() else math.nan
        right = bool(claimed.any()) and seconds <= deadline and _holds(result.t, good, first_claim)
        wrong = bool(claimed.any()) and not bool(good[first_claim])
        trials.append(Trial(float(t), right, wrong, seconds))
    return trials


def kidnapping_trials(log: Log, estimator: str, count: int) -> list[Trial]:
    """Simulate ``count`` kidnappings. In each, the robot is moved from its pose at one time of the log to its pose half a log
    later (or earlier).

    The estimator has recovered if it is correct for 10 s. This must begin within 30 s after 3 different landmarks were measured
    at the new place.
    """
    first, last = log.span()
    stamps, names = _sightings(log)
    trials = []
    for i in range(count):
        t = first + BEFORE + (last - first - BEFORE) * i / count
        other = first + (t - first + 0.5 * (last - first)) % (last - first)
        later = stamps >= other
        deadline = _third(stamps[later], names[later], last) - other + RECOVERY_TIME
        before, after = cut(log, t - BEFORE, t), cut(log, other, other + deadline + 2.0 * HOLD)
        carried = join(before, after, gap=JUMP)
        result = run(carried, RunConfig(estimator, prior="reference", seed=i))
        moved = before.span()[1] + JUMP
        good = is_right(result, carried)
        in_time = np.flatnonzero((result.t >= moved) & (result.t <= moved + deadline))
        seconds = next((float(result.t[k] - moved) for k in in_time if _holds(result.t, good, k)), math.nan)
        at_deadline = int(np.searchsorted(result.t, moved + deadline).clip(max=len(result.t) - 1))
        false = math.isnan(seconds) and result.status[at_deadline] == "localized"
        trials.append(Trial(float(t), not math.isnan(seconds), false, seconds))
    return trials


def _sightings(log: Log) -> tuple[Array, NDArray[np.str_]]:
    """Return the stamps and names of all measurements of landmarks that are in the map."""
    stream = log.streams["bearing_range"]
    assert isinstance(stream, BearingRangeStream)
    names = np.array(stream.landmark)
    known = np.isin(names, list(log.world.landmarks))
    return stream.t[known], names[known]


def _third(stamps: Array, names: NDArray[np.str_], otherwise: float) -> float:
    """Return the time of the first measurement of a third different landmark, or ``otherwise`` if there is none."""
    _, first = np.unique(names, return_index=True)
    return float(stamps[np.sort(first)[LANDMARKS - 1]]) if len(first) >= LANDMARKS else otherwise


def is_right(result: RunResult, log: Log) -> NDArray[np.bool_]:
    """Return a mask of the causal estimates that are correct. An estimate in a gap of the reference has the value of the estimate
    before the gap, or at the beginning of the log that of the first estimate with a reference."""
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


def _holds(t: Array, right: NDArray[np.bool_], first: int) -> bool:
    """True if all estimates are correct for 10 s from index ``first`` on."""
    during = (t >= t[first]) & (t <= t[first] + HOLD)
    return bool(right[during].all())


TRIALS_OF = {"unknown start": start_trials, "kidnapping": kidnapping_trials}


def run_trials(kind: str, log: Log, estimator: str, count: int) -> list[Trial]:
    """Run ``count`` trials on a log. ``kind``: a key of :data:`TRIALS_OF`."""
    return TRIALS_OF[kind](log, estimator, count)
