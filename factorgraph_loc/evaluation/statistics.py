"""Pooled figures, their bootstrap, and paired comparison of two methods on the same cases.

Runs are paired by log and seed; logs are clusters. The interval is a percentile bootstrap over logs and, within each, over seeds
(Davison and Hinkley, "Bootstrap Methods and their Application", 1997, section 3.8).

McNemar's exact test of proportions: McNemar, "Note on the sampling error of the difference between correlated proportions or
percentages", Psychometrika 12(2), 1947, with the exact binomial distribution. Medians: percentile bootstrap over the cases (Efron
and Tibshirani, "An Introduction to the Bootstrap", 1993, section 13.3). A case that never succeeds has an infinite value: the
median exists if more than half of the cases are finite.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from factorgraph_loc.evaluation.pairing import CONFIDENCE
from factors.se2 import Array

ENOUGH_LOGS = 6  # needed for a bootstrap over logs
DRAWS = 4000
_SEED = 0  # of the bootstrap, for reproducible intervals


def average(scores: ArrayLike, *, rms: bool) -> Array:
    """The root mean square, or else the mean, over the rows of ``scores`` (K, ...)."""
    values = np.asarray(scores, dtype=float)
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)) if rms else np.mean(values, axis=0))


def pooled_rms(values: Sequence[float]) -> float:
    """Root mean square of RMSEs of several logs or seeds, with equal weights."""
    return float(average(values, rms=True))


def pair_seeds(a: Mapping[int, float | None], b: Mapping[int, float | None]) -> tuple[Array, int]:
    """Scores (K, 2) of ``a`` and ``b`` by common seed, and the number of missing pairs; None: a run without a score."""
    by_seed = (a, b)
    seeds = sorted(set(a) | set(b))
    both = [[s.get(seed, next(iter(s.values())) if len(s) == 1 else None) for s in by_seed] for seed in seeds]
    if any(len(s) == 1 for s in by_seed):  # paired with each seed of the other, not only with its own seed
        longer = max(by_seed, key=len)
        both = [pair for seed, pair in zip(seeds, both, strict=True) if seed in longer]
    complete = [pair for pair in both if None not in pair]
    return np.array(complete, dtype=float).reshape(-1, 2), len(both) - len(complete)


def bounds(figures: Array) -> tuple[float, float]:
    """The 95 % interval of a figure from its bootstrap draws (D,)."""
    tail = 100.0 * (1.0 - CONFIDENCE) / 2.0
    low, high = np.percentile(figures, (tail, 100.0 - tail))
    return float(low), float(high)


def draw_pooled(clusters: Sequence[Array], *, rms: bool = True) -> Array:
    """Bootstrap of C pooled figures, (DRAWS, C): logs are drawn, and seeds within each.

    ``clusters``: for each log, the scores (K, C) of its K seeds. A pooled figure is the root mean square over seeds, then over
    logs with equal weights, or without ``rms`` the mean of the means.
    """
    scores = np.concatenate([np.square(cluster) if rms else cluster for cluster in clusters])
    drawn = _weights(tuple(map(len, clusters))) @ scores
    return np.asarray(np.sqrt(drawn) if rms else drawn)


@lru_cache(maxsize=2)
def _weights(seeds: tuple[int, ...]) -> Array:
    """The weight of each of all N scores in each draw, (DRAWS, N), for logs with these numbers of seeds."""
    rng = np.random.default_rng(_SEED)
    sizes = np.array(seeds)
    logs = rng.integers(len(sizes), size=(DRAWS, len(sizes)))
    size = sizes[logs][..., None]
    seed = (rng.random((*logs.shape, sizes.max())) * size).astype(int)
    drawn = np.arange(sizes.max()) < size  # a log with fewer seeds draws fewer
    first = np.cumsum(sizes) - sizes
    place = np.arange(DRAWS)[:, None, None] * sizes.sum() + first[logs][..., None] + seed
    weight = drawn / (size * len(sizes))
    counted = np.bincount(place.ravel(), weights=weight.ravel(), minlength=DRAWS * int(sizes.sum()))
    return np.asarray(counted.reshape(DRAWS, -1))


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
    return McNemar(only_a, only_b, min(1.0, 2.0 * float(scipy.special.bdtr(min(only_a, only_b), uneven, 0.5))))


def quantile(values: ArrayLike, share: float) -> float:
    """The least of the values (N,) that is at least as large as this ``share`` of them, which may be infinite; NaN if N is 0."""
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
        figures = compare(np.median(first[cases], axis=1), np.median(second[cases], axis=1))
    tail = (1.0 - CONFIDENCE) / 2.0
    # a draw with two infinite medians extends the interval to both sides
    unknown = np.isnan(figures[1:])
    low = quantile(np.where(unknown, lowest, figures[1:]), tail)
    high = quantile(np.where(unknown, math.inf, figures[1:]), 1.0 - tail)
    return Interval(float(figures[0]), low, high)
