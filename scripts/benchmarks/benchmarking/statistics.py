"""Statistics of many runs of one kind: consistency at each time, ratios of errors, counts, times.

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
    """Fraction of the times at which the mean NEES over runs is in its 95 % band; 95 % for a consistent estimator.

    ``nees`` (R, N): of R independent runs at N times, NaN where missing. Times without any run do not count; NaN if all are.
    """
    known = np.isfinite(nees)
    count = known.sum(axis=0)
    count = count[count > 0]
    total = np.where(known, nees, 0.0).sum(axis=0)[known.any(axis=0)]
    low, high = (chi2.ppf(tail, dof * count) for tail in ((1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0))
    return float(np.mean((total >= low) & (total <= high))) if len(count) else math.nan


@dataclass(frozen=True)
class Ratio:
    """Of pooled RMSEs, with the 95 % interval ``low`` to ``high``; ``worst``: the largest of a single run."""

    value: float
    low: float
    high: float
    worst: float


def rmse_ratio(a: Array, b: Array) -> Ratio:
    """RMSEs ``a`` (R,) over ``b`` (R,) of the same R logs, pooled; the interval is a percentile bootstrap over the logs, paired."""
    drawn = np.random.default_rng(_SEED).integers(len(a), size=(DRAWS, len(a)))
    squares = np.mean(np.square(a)[drawn], axis=1) / np.mean(np.square(b)[drawn], axis=1)
    tail = 100.0 * (1.0 - CONFIDENCE) / 2.0
    low, high = np.percentile(np.sqrt(squares), (tail, 100.0 - tail))
    value = pooled_rms(a.tolist()) / pooled_rms(b.tolist())
    return Ratio(value, float(low), float(high), float(np.max(a / b)))


def first_held(t: Array, good: NDArray[np.bool_], hold: float) -> float:
    """The first of the times ``t`` (N,), ascending, from which on all are ``good`` (N,) for ``hold`` seconds; NaN if there is
    none.

    Times less than ``hold`` before the end do not count.
    """
    bad = np.concatenate((np.zeros(1, dtype=np.int64), np.cumsum(~good)))
    end = np.searchsorted(t, t + hold + 1e-9, side="right")
    held = (bad[end] == bad[:-1]) & (t[-1] >= t + hold - 1e-9) if len(t) else np.empty(0, dtype=bool)
    return float(t[np.argmax(held)]) if held.any() else math.nan
