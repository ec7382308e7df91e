"""Test of a calibration by cross-validation: errors of estimators on held-out logs, or parts of a log.

Each held-out part is run with the input rig, and with a rig that is learnt from the remaining parts.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from factorgraph_loc.calibration.learn import calibrators
from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.model.log import Log, cut
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.scoring import KINDS
from factorgraph_loc.sensors.motion import odometry_of, overlap
from factorgraph_loc.sensors.smoothed import recordings

ESTIMATORS = ("ekf", "smoother")
RIGS = ("input", "learnt")
LONGEST = 150.0  # s; maximum duration of a held-out section of a log
MOST = 4  # maximum number of sections of a log
FEWEST_POSES = 20  # minimum number of poses of the reference in a section
WORSE, WORST = 1.02, 1.10  # a rig is refused if its error grows by a larger factor, over all logs or on one log

Scores = Mapping[str, Any]


class Scored(Protocol):
    """A scored run. ``result``: the result of the estimator. ``scores``: the errors of ``result`` by name, from
    :func:`factorgraph_loc.evaluation.metrics.score`."""

    @property
    def result(self) -> RunResult: ...
    @property
    def scores(self) -> Scores: ...


Run = Callable[[Log, str], Scored]
"""Runs an estimator on a log, with the sensors of the log's rig."""


@dataclass(frozen=True)
class Trial:
    """The scores of an ``estimator`` on one held-out section of a log, with the input rig and with the learnt rig.

    ``log``: name of the log. ``scores``: the scores of the run with each rig, by the names in :data:`RIGS`. None if the
    run failed.
    ``doubted``: probabilities that landmarks or tags have moved or are dead, as {kind: {name: probability}}, from the
    run with the learnt rig.
    """

    log: str
    estimator: str
    scores: Mapping[str, Scores | None]
    doubted: Mapping[str, Mapping[str, float]]


def folds_of(logs: Sequence[Log]) -> list[tuple[list[Log], list[Log]]]:
    """Return the folds of a cross-validation, as pairs of the logs to learn from and the held-out sections. Each
    recording is held out once. If all logs are of one recording, its two halves are the two recordings."""
    parts = list(zip(recordings(logs), logs, strict=True))
    if len({number for number, _ in parts}) == 1:
        halves = [(half, _section(log, half / 2, (half + 1) / 2)) for half in range(2) for log in logs]
        parts = [(half, part) for half, part in halves if part is not None]
    return [
        (
            [log for part, log in parts if part != number],
            [section for part, log in parts if part == number for section in _sections(log)],
        )
        for number in dict.fromkeys(number for number, _ in parts)
        if any(part != number for part, _ in parts)
    ]


def trials_of(tests: Sequence[Log], initial: Rig, learnt: Rig, run: Run) -> list[Trial]:
    """Return the scores of runs with the rigs ``initial`` and ``learnt``. There is one trial for each of the
    :data:`ESTIMATORS` and each held-out section in ``tests``.

    ``run(log, estimator)``: runs the named estimator on a log. The rig ``initial`` is omitted if it lacks settings that
    its sensors need.
    """
    complete = all(calibrator.is_complete(initial) for calibrator in calibrators(initial).values())
    rigs = {"learnt": learnt} | ({"input": initial} if complete else {})
    out = []
    for test in tests:
        for estimator in ESTIMATORS:
            runs = dict[str, Scored]()
            for name, rig in rigs.items():
                with suppress(InputError, RunFailedError):
                    runs[name] = run(replace(test, rig=rig), estimator)
            doubted = runs["learnt"].result.diagnostics.doubted if "learnt" in runs else {}
            scores = {name: runs[name].scores if name in runs else None for name in RIGS}
            out.append(Trial(test.name, estimator, scores, doubted))
    return out


def pooled(trials: Sequence[Trial], rig: str, key: str) -> float:
    """Return one score for all held-out sections in ``trials``, weighted by numbers of poses: root mean square, or mean
    for ANEES.

    ``rig``: one of :data:`RIGS`. ``key``: name of the score, such as "final.position_rmse". Only sections with a score
    of both rigs are used, if there are any. Returns NaN if no section has the score.
    """
    kind = key.partition(".")[0]
    known = [t for t in trials if _is_known(t, key)]
    scores = [t.scores[rig] for t in known or trials]
    rows = [(float(s[f"{kind}.scored"]), float(s[key])) for s in scores if s is not None and s.get(key) is not None]
    if not sum(weight for weight, _ in rows):
        return math.nan
    weights, values = np.array(rows).T
    if key.endswith("anees"):
        return float(np.average(values, weights=weights))
    return math.sqrt(np.average(values**2, weights=weights))


def _is_known(trial: Trial, key: str) -> bool:
    """True if a trial has the score ``key`` with every rig."""
    return all(scores is not None and scores.get(key) is not None for scores in trial.scores.values())


def growth(trials: Sequence[Trial]) -> float:
    """Return the ratio of the position RMSE on held-out sections with the learnt rig to that with the input rig. It is
    the geometric mean over the estimators and over causal and final trajectories. Returns NaN if no section has an RMSE
    with both rigs."""
    return _ratio(trials, lambda mine, rig, kind: pooled(mine, rig, f"{kind}.position_rmse"))


def _ratio(trials: Sequence[Trial], loss: Callable[[Sequence[Trial], str, str], float]) -> float:
    """Return the ratio of a loss with the learnt rig to that with the input rig. Returns NaN if no trial has both
    scores.

    ``loss``: a function (trials, rig, kind) that returns a number, where kind is "causal" or "final". The ratio is the
    geometric mean over the estimators and over causal and final trajectories.
    """
    ratios = [
        loss(mine, "learnt", kind) / max(loss(mine, "input", kind), 1e-9)
        for estimator in ESTIMATORS
        for kind in KINDS
        if (mine := [t for t in trials if t.estimator == estimator and _is_known(t, f"{kind}.position_rmse")])
    ]
    return math.exp(np.mean(np.log(ratios))) if ratios else math.nan


def _anees_factor(trials: Sequence[Trial], rig: str, kind: str) -> float:
    """Return max(r, 1 / r), where r is the pooled ANEES of a rig divided by its ideal value, the number of dimensions.
    ``rig``: one of :data:`RIGS`. ``kind``: "causal" or "final"."""
    dimensions = 3.0 if math.isfinite(pooled(trials, rig, f"{kind}.heading_rmse")) else 2.0
    factor = max(pooled(trials, rig, f"{kind}.anees") / dimensions, 1e-9)
    return max(factor, 1.0 / factor)


def refusal(trials: Sequence[Trial]) -> str:
    """Return the reason to refuse the learnt rig, such as larger errors on held-out logs, or "" if there is none."""
    failed = [t for t in trials if t.scores["learnt"] is None and t.scores["input"] is not None]
    if failed:
        return f"the {failed[0].estimator} fails on {failed[0].log} with the rig that is learnt from the other data"
    if (pooled_growth := growth(trials)) > WORSE:
        return f"errors on held-out logs are {pooled_growth:.2f} times those with the input rig"
    for log in dict.fromkeys(t.log for t in trials):
        if (own := growth([t for t in trials if t.log == log])) > WORST:
            return f"errors on {log}, held out, are {own:.2f} times those with the input rig"
    # WORST limits ratios of standard deviations; ANEES is a ratio of variances, so that its limit is squared
    if (away := _ratio(trials, _anees_factor)) > WORST**2 and pooled_growth > 1.0 / WORST:
        ratio = f"{pooled_growth:.2f} times those with the input rig"
        return f"errors on held-out logs are {ratio}, but ANEES is {away:.2f} times as far from its ideal"
    return ""


def _section(log: Log, begin: float, end: float) -> Log | None:
    """Return a section of a log, or None if it has no measurements, or lacks odometry or the reference. ``begin``,
    ``end``: its ends, as fractions (0 to 1) of the time with both odometry and reference."""
    first, last = overlap(log)
    with suppress(InputError):  # if the section has no measurements
        part = cut(log, first + begin * (last - first), first + end * (last - first))
        if part.reference is not None and len(odometry_of(part).t):
            return part
    return None


def _sections(log: Log) -> list[Log]:
    """Return evenly spread sections of a log, with at least :data:`FEWEST_POSES` poses of the reference each."""
    first, last = overlap(log)
    edges = np.linspace(0.0, 1.0, min(MOST, max(1, round((last - first) / LONGEST))) + 1)
    out = []
    for begin, end in pairwise(edges.tolist()):
        margin = max(0.0, 0.5 * (end - begin - LONGEST / (last - first)))
        part = _section(log, begin + margin, end - margin)
        if part is not None and part.reference is not None and len(part.reference) >= FEWEST_POSES:
            out.append(part)
    return out
