"""Errors of estimators on held-out logs, or parts of a log, with the input rig and with rigs that were learnt from the rest."""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.calibration.learn import calibrators
from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.model.log import Log, cut
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.scoring import KINDS
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.odometry.calibration import odometry_of

ESTIMATORS = ("ekf", "smoother")
PARTS = 2  # of a single recording, each held out once
LONGEST = 150.0  # s of each part that is run
MOST = 4  # stretches of a log
WARM_UP = 2.0  # s of odometry before a stretch, for the delay of commands
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
class Fold:
    """A split of the logs: ``train`` to learn from, ``tests`` held out."""

    train: tuple[Log, ...]
    tests: tuple[Log, ...]


@dataclass(frozen=True)
class Trial:
    """Scores of an ``estimator`` on a held-out stretch of ``log``, with the rig ``before`` and ``after``; None where it failed.
    ``doubted``: by kind of doubt, what in the map is probably not as the map has it, according to the run after."""

    log: str
    estimator: str
    before: Scores | None
    after: Scores | None
    doubted: Mapping[str, Mapping[str, float]]


def folds_of(logs: Sequence[Log]) -> tuple[Fold, ...]:
    """Folds over the recordings, or over the parts of a single one."""
    parts = recordings(logs)
    if len(set(parts)) > 1:
        return tuple(
            Fold(
                tuple(log for log, p in zip(logs, parts, strict=True) if p != part),
                tuple(
                    test for log, p in zip(logs, parts, strict=True) if p == part for test in _stretches(log, 0.0, 1.0)
                ),
            )
            for part in dict.fromkeys(parts)
        )
    shares = [(k / PARTS, (k + 1) / PARTS) for k in range(PARTS)]
    return tuple(
        Fold(
            tuple(_silenced(log, a, b) for log in logs),
            tuple(test for log in logs for test in _stretches(log, a, b)),
        )
        for a, b in shares
    )


def recordings(logs: Sequence[Log]) -> list[int]:
    """The number of the recording behind each log: logs with the same measurements are not independent."""
    found = [one.recordings(logs) for one in calibrators().values() if one.channel in logs[0].streams]
    return next((numbers for numbers in found if len(set(numbers)) < len(logs)), list(range(len(logs))))


def tried(tests: Sequence[Log], before: Rig, after: Rig, run: Run) -> list[Trial]:
    """Both estimators on held-out stretches, with both rigs. A rig that lacks what its sensors need is not tried."""
    complete = all(one.is_complete(before) for one in calibrators().values())
    out = []
    for test in tests:
        for estimator in ESTIMATORS:
            found: list[Scored | None] = [None, None]
            for i, rig in ((0, before), (1, after))[0 if complete else 1 :]:
                with suppress(InputError, RunFailedError):
                    found[i] = run(replace(test, rig=rig), estimator)
            doubted = {} if found[1] is None else found[1].result.diagnostics.doubted
            scores = [None if one is None else one.scores for one in found]
            out.append(Trial(test.name, estimator, scores[0], scores[1], doubted))
    return out


def pooled(trials: Sequence[Trial], which: int, key: str) -> float:
    """The root mean square over poses of stretches with the rig before (0) or after (1), or the mean for ``anees``; NaN if there
    are none. Stretches without scores of both rigs count only if all are such."""
    kind = key.partition(".")[0]
    known = [t for t in trials if _known(t, key)]
    scores = [(t.before, t.after)[which] for t in known or trials]
    found = [(float(s[f"{kind}.scored"]), float(s[key])) for s in scores if s is not None and s.get(key) is not None]
    if not sum(weight for weight, _ in found):
        return math.nan
    weights, values = np.array(found).T
    if key.endswith("anees"):
        return float(np.average(values, weights=weights))
    return math.sqrt(np.average(values**2, weights=weights))


def _known(trial: Trial, key: str) -> bool:
    return all(one is not None and one.get(key) is not None for one in (trial.before, trial.after))


def growth(trials: Sequence[Trial]) -> float:
    """Position error after, divided by that before: geometric mean over estimators, causal and final poses; NaN if unknown."""
    ratios = [
        pooled(mine, 1, key) / max(pooled(mine, 0, key), 1e-9)
        for estimator in ESTIMATORS
        for key in (f"{kind}.position_rmse" for kind in KINDS)
        if (mine := [t for t in trials if t.estimator == estimator and _known(t, key)])
    ]
    return math.exp(np.mean(np.log(ratios))) if ratios else math.nan


def refusal(trials: Sequence[Trial]) -> str:
    """Why the learnt rig is refused; empty if it is not."""
    failed = [t for t in trials if t.after is None and t.before is not None]
    if failed:
        return f"the {failed[0].estimator} fails on {failed[0].log} with what was learnt from the rest"
    every = growth(trials)
    if every > WORSE:
        return f"errors on held-out logs are {every:.2f} times those with the input rig"
    for log in dict.fromkeys(t.log for t in trials):
        if (own := growth([t for t in trials if t.log == log])) > WORST:
            return f"errors on {log}, held out, are {own:.2f} times those with the input rig"
    return ""


def _bounds(log: Log) -> tuple[float, float]:
    """The interval [s] in which the log has both odometry and reference."""
    assert log.reference is not None
    t = odometry_of(log).t + log.rig.time_offset("odometry")
    return max(float(t[0]), float(log.reference.t[0])), min(float(t[-1]), float(log.reference.t[-1]))


def _silenced(log: Log, begin: float, end: float) -> Log:
    """The log without its reference between two fractions of its duration."""
    assert log.reference is not None
    first, last = _bounds(log)
    share = (log.reference.t - first) / max(last - first, 1e-9)
    return replace(log, reference=_kept(log.reference, (share < begin) | (share >= end)))


def _kept(reference: Trajectory, keep: NDArray[np.bool_]) -> Trajectory:
    covariances = None if reference.covariances is None else reference.covariances[keep]
    return replace(reference, t=reference.t[keep], poses=reference.poses[keep], covariances=covariances)


def _stretches(log: Log, begin: float, end: float) -> list[Log]:
    """Stretches of a log between two fractions of its duration, without those that lack reference or measurements."""
    first, last = _bounds(log)
    whole = (last - first) * (end - begin)
    count = min(MOST, max(1, round(whole / LONGEST)))
    edges = first + (last - first) * np.linspace(begin, end, count + 1)
    out = []
    for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        margin = max(0.0, 0.5 * (b - a - LONGEST))
        with suppress(InputError):  # no measurements there
            part = cut(log, a + margin - WARM_UP, b - margin)
            reference = part.reference
            if reference is not None and len(odometry_of(part).t):
                keep = reference.t >= a + margin
                if keep.sum() >= FEWEST_POSES:
                    out.append(replace(part, reference=_kept(reference, keep)))
    return out
