"""Statistics of many runs of one kind: consistency of covariances, ratios of errors, and times.

NEES over runs: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from factorgraph_loc.evaluation.pairing import CONFIDENCE
from factorgraph_loc.evaluation.statistics import pooled_rms
from factors.se2 import Array

DRAWS = 4000
_SEED = 0  # of the bootstrap, for reproducible intervals


def share_in_band(nees: Array, dof: int = 3) -> float:
    """Return the fraction of the times at which the mean NEES over runs is in its 95 % interval. It is 0.95 for a consistent
    estimator.

    ``nees`` (R, N): of R independent runs at N times, NaN where missing. ``dof``: degrees of freedom. Times without any value are
    left out. Returns NaN if there are no values.
    """
    known = np.isfinite(nees)
    count = known.sum(axis=0)
    count = count[count > 0]
    total = np.where(known, nees, 0.0).sum(axis=0)[known.any(axis=0)]
    low, high = (chi2.ppf(tail, dof * count) for tail in ((1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0))
    return float(np.mean((total >= low) & (total <= high))) if len(count) else math.nan


@dataclass(frozen=True)
class Ratio:
    """A ratio of two pooled RMSEs. ``value``: the ratio. ``low``, ``high``: its 95 % interval. ``worst``: the largest ratio of a
    single log."""

    value: float
    low: float
    high: float
    worst: float


def rmse_ratio(a: Array, b: Array) -> Ratio:
    """Return the ratio of pooled RMSEs, ``a`` over ``b``. Both are arrays (R,) of the RMSEs on the same R logs. The interval is a
    paired percentile bootstrap over logs."""
    drawn = np.random.default_rng(_SEED).integers(len(a), size=(DRAWS, len(a)))
    squares = np.mean(np.square(a)[drawn], axis=1) / np.mean(np.square(b)[drawn], axis=1)
    tail = 100.0 * (1.0 - CONFIDENCE) / 2.0
    low, high = np.percentile(np.sqrt(squares), (tail, 100.0 - tail))
    value = pooled_rms(a.tolist()) / pooled_rms(b.tolist())
    return Ratio(value, float(low), float(high), float(np.max(a / b)))


def first_held(t: Array, good: NDArray[np.bool_], hold: float) -> float:
    """Return the first time from which on an estimate is good for ``hold`` [s], or NaN if there is none.

    ``t`` (N,) [s]: ascending times. ``good`` (N,): mask of the times at which the estimate is good. Times less than ``hold``
    before the last time are not considered.
    """
    bad = np.concatenate((np.zeros(1, dtype=np.int64), np.cumsum(~good)))
    end = np.searchsorted(t, t + hold + 1e-9, side="right")
    held = (bad[end] == bad[:-1]) & (t[-1] >= t + hold - 1e-9) if len(t) else np.empty(0, dtype=bool)
    return float(t[np.argmax(held)]) if held.any() else math.nan
