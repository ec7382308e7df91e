"""Measurement noise for which an estimator is consistent: its stated covariance equals its mean squared error.

Errors of consecutive sightings are correlated, whereas estimators assume them independent. With the scatter of the residuals as
noise an estimator is therefore overconfident. One factor on the standard deviations of range and bearing compensates for that.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig

Evaluate = Callable[[Log], Mapping[str, Any]]
"""Runs an estimator on a log, with the log's rig, and returns the scores of :func:`factorgraph_loc.evaluation.metrics.score`.
"""

FACTORS = (0.5, 30.0)  # bounds of the factor
TOLERANCE = 0.08  # of the logarithm of ANEES
TRIALS = 6
MAX_FINAL = 1.5  # times the ideal; above it the final ANEES counts too
MIN_SCORED = 100  # poses needed for a meaningful score
_SLOPE = -1.2  # of log ANEES over log factor, assumed after a single trial


@dataclass(frozen=True)
class Trial:
    """Causal and final ANEES over its ideal value, means over logs, and the scores of each log."""

    factor: float
    causal: float
    final: float
    scores: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True)
class Consistency:
    """The rig with adjusted noise, the trial with it, and ``reached``: whether ANEES is ideal within the tolerance, or below it
    at the least factor.

    ``trial`` is None where no log can be scored; the noise is then the scatter of the residuals.
    """

    rig: Rig
    trial: Trial | None
    reached: bool


Change = Callable[[Rig, float], Rig]


def make_consistent(
    logs: Sequence[Log],
    rig: Rig,
    evaluate: Evaluate,
    guess: float,
    change: Change,
    least: float = FACTORS[0],
) -> Consistency:
    """Find the factor on a sensor's noise for which the estimator's ANEES on ``logs`` is ideal.

    ``guess``: the first factor tried; ``least``: lower bound, at which the estimator may remain conservative; ``change``:
    returns the rig with the sensor's standard deviations multiplied by a factor. The criterion is the causal ANEES; if the
    final estimates are then overconfident, the geometric mean of both.
    """
    trials: list[Trial] = []

    def at(factor: float) -> Trial:
        changed = change(rig, factor)
        trials.append(_trial(factor, [evaluate(replace(log, rig=changed)) for log in logs], logs))
        return trials[-1]

    if not math.isfinite(at(guess).causal):
        return Consistency(rig, None, False)
    trial = _solve(at, trials, lambda t: math.log(t.causal), least)
    if trial.final > MAX_FINAL:
        trial = _solve(at, trials, _both, least)
        left = _both(trial)
    else:
        left = math.log(trial.causal)
    reached = abs(left) < 2.0 * TOLERANCE or (left < 0.0 and trial.factor <= least)
    return Consistency(change(rig, trial.factor), trial, reached)


def _both(trial: Trial) -> float:
    return 0.5 * (math.log(trial.causal) + math.log(trial.final))


def _solve(at: Callable[[float], Trial], trials: list[Trial], excess: Callable[[Trial], float], least: float) -> Trial:
    """The trial whose ``excess``, decreasing in the factor, is nearest to zero, by the secant method in logarithms."""
    low, high = math.log(least), math.log(FACTORS[1])
    for _ in range(TRIALS):
        nearest = sorted(trials, key=lambda t: abs(excess(t)))[:2]
        best = nearest[0]
        if abs(excess(best)) < TOLERANCE:
            break
        slope = _SLOPE
        if len(nearest) > 1:
            step = math.log(nearest[1].factor / best.factor)
            slope = min((excess(nearest[1]) - excess(best)) / step, -0.2) if abs(step) > 1e-3 else _SLOPE
        goal = math.log(best.factor) - excess(best) / slope
        goal = float(np.clip(np.clip(goal, math.log(best.factor) - 1.2, math.log(best.factor) + 1.2), low, high))
        if any(abs(goal - math.log(t.factor)) < 1e-3 for t in trials):
            break
        at(math.exp(goal))
    return min(trials, key=lambda t: abs(excess(t)))


def _trial(factor: float, scores: Sequence[Mapping[str, Any]], logs: Sequence[Log]) -> Trial:
    causal, final = (relative_anees(scores, logs, kind) for kind in ("causal", "final"))
    return Trial(factor, causal, final, tuple(scores))


def relative_anees(scores: Sequence[Mapping[str, Any]], logs: Sequence[Log], kind: str) -> float:
    """ANEES over its ideal value (3, or 2 without the reference's heading), mean over the logs that can be scored, else NaN."""
    found = [
        s[f"{kind}.anees"] / (3.0 if log.reference is not None and log.reference.has_heading else 2.0)
        for s, log in zip(scores, logs, strict=True)
        if s[f"{kind}.anees"] and s[f"{kind}.scored"] >= MIN_SCORED
    ]
    return float(np.mean(found)) if found else math.nan
