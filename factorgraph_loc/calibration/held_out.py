"""Errors of estimators on held-out logs, or parts of a log, with the input rig and with rigs that were learnt from the rest."""

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
LONGEST = 150.0  # s of each stretch that is run
MOST = 4  # stretches of a log
FEWEST_POSES = 20  # poses of the reference that a stretch needs
WORSE, WORST = 1.02, 1.10  # growth of the pooled error, and of that of a log, with which a rig is refused

Scores = Mapping[str, Any]


class Scored(Protocol):
    """The ``result`` of an estimator, and its ``scores`` as of :func:`factorgraph_loc.evaluation.metrics.score`."""

    @property
    def result(self) -> RunResult: ...
    @property
    def scores(self) -> Scores: ...


Run = Callable[[Log, str], Scored]
"""Runs an estimator on a log, with the sensors of the log's rig."""


@dataclass(frozen=True)
class Trial:
    """The ``scores`` of an ``estimator`` on a held-out stretch of ``log``, with the rigs of :data:`RIGS`; None if it failed.
    ``doubted``: elements of the map that the run with the learnt rig doubts, with their probabilities, by kind of doubt."""

    log: str
    estimator: str
    scores: Mapping[str, Scores | None]
    doubted: Mapping[str, Mapping[str, float]]


def folds_of(logs: Sequence[Log]) -> list[tuple[list[Log], list[Log]]]:
    """Logs to learn from, and held-out stretches, for each recording, or for each half of a single one."""
    parts = list(zip(recordings(logs), logs, strict=True))
    if len({number for number, _ in parts}) == 1:
        halves = [(half, _share(log, half / 2, (half + 1) / 2)) for half in range(2) for log in logs]
        parts = [(half, part) for half, part in halves if part is not None]
    return [
        (
            [log for part, log in parts if part != number],
            [stretch for part, log in parts if part == number for stretch in _stretches(log)],
        )
        for number in dict.fromkeys(number for number, _ in parts)
        if any(part != number for part, _ in parts)
    ]


def trials_of(tests: Sequence[Log], initial: Rig, learnt: Rig, run: Run) -> list[Trial]:
    """Both estimators on held-out stretches, with both rigs. A rig that lacks what its sensors need is not tried."""
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
    """The root mean square over poses of stretches with a ``rig`` of :data:`RIGS`, or the mean for ``anees``; NaN if there are
    none. Stretches without scores of both rigs count only if all are such."""
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
    return all(scores is not None and scores.get(key) is not None for scores in trial.scores.values())


def growth(trials: Sequence[Trial]) -> float:
    """Position error with the learnt rig divided by that with the input rig: geometric mean over estimators, causal and final
    poses; NaN if unknown."""
    return _ratio(trials, lambda mine, rig, kind: pooled(mine, rig, f"{kind}.position_rmse"))


def _ratio(trials: Sequence[Trial], loss: Callable[[Sequence[Trial], str, str], float]) -> float:
    """The ``loss`` with the learnt rig divided by that with the input rig, as the geometric mean over estimators and poses."""
    ratios = [
        loss(mine, "learnt", kind) / max(loss(mine, "input", kind), 1e-9)
        for estimator in ESTIMATORS
        for kind in KINDS
        if (mine := [t for t in trials if t.estimator == estimator and _is_known(t, f"{kind}.position_rmse")])
    ]
    return math.exp(np.mean(np.log(ratios))) if ratios else math.nan


def _anees_factor(trials: Sequence[Trial], rig: str, kind: str) -> float:
    """The factor between ANEES and its ideal, the number of dimensions, in whichever direction."""
    dimensions = 3.0 if math.isfinite(pooled(trials, rig, f"{kind}.heading_rmse")) else 2.0
    factor = max(pooled(trials, rig, f"{kind}.anees") / dimensions, 1e-9)
    return max(factor, 1.0 / factor)


def refusal(trials: Sequence[Trial]) -> str:
    """The reason to refuse the learnt rig; empty if there is none."""
    failed = [t for t in trials if t.scores["learnt"] is None and t.scores["input"] is not None]
    if failed:
        return f"the {failed[0].estimator} fails on {failed[0].log} with what was learnt from the rest"
    if (pooled_growth := growth(trials)) > WORSE:
        return f"errors on held-out logs are {pooled_growth:.2f} times those with the input rig"
    for log in dict.fromkeys(t.log for t in trials):
        if (own := growth([t for t in trials if t.log == log])) > WORST:
            return f"errors on {log}, held out, are {own:.2f} times those with the input rig"
    # ANEES is a ratio of squares: standard deviations may be worse by WORST, unless errors are smaller by that
    if (away := _ratio(trials, _anees_factor)) > WORST**2 and pooled_growth > 1.0 / WORST:
        ratio = f"{pooled_growth:.2f} times those with the input rig"
        return f"errors on held-out logs are {ratio}, but ANEES is {away:.2f} times as far from its ideal"
    return ""


def _share(log: Log, begin: float, end: float) -> Log | None:
    """The part of a log between two fractions of the time that has both odometry and reference; None if it has none of these."""
    first, last = overlap(log)
    with suppress(InputError):  # no measurements there
        part = cut(log, first + begin * (last - first), first + end * (last - first))
        if part.reference is not None and len(odometry_of(part).t):
            return part
    return None


def _stretches(log: Log) -> list[Log]:
    """Stretches of a log with enough poses of the reference."""
    first, last = overlap(log)
    edges = np.linspace(0.0, 1.0, min(MOST, max(1, round((last - first) / LONGEST))) + 1)
    out = []
    for begin, end in pairwise(edges.tolist()):
        margin = max(0.0, 0.5 * (end - begin - LONGEST / (last - first)))
        part = _share(log, begin + margin, end - margin)
        if part is not None and part.reference is not None and len(part.reference) >= FEWEST_POSES:
            out.append(part)
    return out
