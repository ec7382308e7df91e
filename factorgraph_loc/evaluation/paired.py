"""Paired comparison of two methods on the same cases, with intervals.

McNemar's exact test of proportions: McNemar, "Note on the sampling error of the difference between correlated proportions or
percentages", Psychometrika 12(2), 1947, with the exact binomial distribution. Medians: percentile bootstrap over the cases (Efron
and Tibshirani, "An Introduction to the Bootstrap", 1993, section 13.3). A case that never succeeds has an infinite value: the
median exists if more than half of the cases are finite.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest

from factorgraph_loc.evaluation.metrics import CONFIDENCE
from factors.se2 import Array

DRAWS = 4000
_SEED = 0  # of the bootstrap, for reproducible intervals


@dataclass(frozen=True)
class McNemar:
    """The number of cases with the event ``only_a`` and ``only_b``, and the two-sided ``p`` value for equal rates."""

    only_a: int
    only_b: int
    p: float


@dataclass(frozen=True)
class Interval:
    """A figure and its 95 % interval. The figure is NaN if undefined; bounds may be infinite."""

    value: float
    low: float
    high: float


def mcnemar(a: ArrayLike, b: ArrayLike) -> McNemar:
    """McNemar's exact test for an event that occurred (N,) with ``a`` and with ``b`` in the same N cases."""
    first, second = np.asarray(a, dtype=bool), np.asarray(b, dtype=bool)
    only_a, only_b = int(np.sum(first & ~second)), int(np.sum(second & ~first))
    uneven = only_a + only_b
    return McNemar(only_a, only_b, float(binomtest(only_a, uneven).pvalue) if uneven else 1.0)


def quantile(values: ArrayLike, share: float) -> float:
    """The least of the values (N,) that is at least as large as this ``share`` of them; values may be infinite. NaN without
    values.
    """
    known = np.asarray(values, dtype=float)
    return float(np.quantile(known, share, method="inverted_cdf")) if len(known) else math.nan


def median_difference(a: ArrayLike, b: ArrayLike) -> Interval:
    """Median of ``a`` (N,) minus that of ``b`` (N,) in the same N cases; values may be infinite."""
    return _of_medians(np.subtract, a, b, lowest=-math.inf)


def median_ratio(a: ArrayLike, b: ArrayLike) -> Interval:
    """Median of ``a`` (N,) over that of ``b`` (N,) in the same N cases; values must not be negative and may be infinite."""
    return _of_medians(np.divide, a, b, lowest=0.0)


def _of_medians(
    compare: Callable[[NDArray[np.float64], NDArray[np.float64]], Array], a: ArrayLike, b: ArrayLike, *, lowest: float
) -> Interval:
    first, second = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if not len(first):
        return Interval(math.nan, lowest, math.inf)
    drawn = np.random.default_rng(_SEED).integers(len(first), size=(DRAWS, len(first)))
    # the original cases come first: their figure is the value
    cases = np.vstack((np.arange(len(first)), drawn))
    with np.errstate(invalid="ignore", divide="ignore"):
        found = compare(np.median(first[cases], axis=1), np.median(second[cases], axis=1))
    tail = (1.0 - CONFIDENCE) / 2.0
    # a draw in which both medians are infinite extends the interval to both sides
    unknown = np.isnan(found[1:])
    low = quantile(np.where(unknown, lowest, found[1:]), tail)
    high = quantile(np.where(unknown, math.inf, found[1:]), 1.0 - tail)
    return Interval(float(found[0]), low, high)
