"""Pooled scores, their bootstrap, and the comparison of two methods on the same cases.

Runs are paired by log and seed, and logs are clusters. Intervals are percentile bootstraps over logs and, within each
log, over seeds (Davison and Hinkley, "Bootstrap Methods and their Application", 1997, section 3.8).

Proportions are compared by McNemar's test with the exact binomial distribution: McNemar, "Note on the sampling error of the
difference between correlated proportions or percentages", Psychometrika 12(2), 1947. Intervals of medians are percentile bootstraps
over the cases (Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, section 13.3). A case without success, such as a
robot that is never localized, has an infinite value. The median is finite if more than half of the cases are.
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

ENOUGH_LOGS = 6  # minimum number of logs for a bootstrap over logs
DRAWS = 4000  # number of draws of a bootstrap
_SEED = 0  # seed of the bootstrap; a constant seed makes intervals reproducible


def average(scores: ArrayLike, *, rms: bool) -> Array:
    """Return the mean over the rows of ``scores`` (K, ...), or the root mean square if ``rms`` is set."""
    values = np.asarray(scores, dtype=float)
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)) if rms else np.mean(values, axis=0))


def pooled_rms(values: Sequence[float]) -> float:
    """Return the root mean square of the RMSEs of several logs or seeds, with equal weights."""
    return float(average(values, rms=True))


def pair_seeds(a: Mapping[int, float | None], b: Mapping[int, float | None]) -> tuple[Array, int]:
    """Return the scores of two methods with the same seeds (K, 2), and the number of seeds without a pair.

    ``a``, ``b``: {seed: score of the run, None if it has none}. If a method has a single run, it is paired with each
    run of the other method.
    """
    by_seed = (a, b)
    seeds = sorted(set(a) | set(b))
    both = [[s.get(seed, next(iter(s.values())) if len(s) == 1 else None) for s in by_seed] for seed in seeds]
    if any(len(s) == 1 for s in by_seed):  # a single run is paired with the seeds of the other method only
        longer = max(by_seed, key=len)
        both = [pair for seed, pair in zip(seeds, both, strict=True) if seed in longer]
    complete = [pair for pair in both if None not in pair]
    return np.array(complete, dtype=float).reshape(-1, 2), len(both) - len(complete)


def bounds(figures: Array) -> tuple[float, float]:
    """Return the 95 % interval of a score from its bootstrap draws ``figures`` (D,)."""
    tail = 100.0 * (1.0 - CONFIDENCE) / 2.0
    low, high = np.percentile(figures, (tail, 100.0 - tail))
    return float(low), float(high)


def draw_pooled(clusters: Sequence[Array], *, rms: bool = True) -> Array:
    """Return bootstrap draws (DRAWS, C) of C pooled scores. A draw resamples the logs, and the seeds within each log.

    ``clusters``: for each log, the scores (K, C) with K seeds. Scores are pooled over seeds, and then over logs with
    equal weights. ``rms``: whether to pool by the root mean square instead of the mean.
    """
    scores = np.concatenate([np.square(cluster) if rms else cluster for cluster in clusters])
    drawn = _weights(tuple(map(len, clusters))) @ scores
    return np.asarray(np.sqrt(drawn) if rms else drawn)


@lru_cache(maxsize=2)
def _weights(seeds: tuple[int, ...]) -> Array:
    """Return the weights (DRAWS, N) of N scores in each bootstrap draw. ``seeds``: number of seeds of each log."""
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
    """The result of McNemar's test, which compares the frequency of an event with two methods a and b.

    ``only_a``, ``only_b``: number of cases that have the event only with method a, or only with b. ``p``: two-sided p
    value of the hypothesis that the event is equally frequent with both.
    """

    only_a: int
    only_b: int
    p: float


@dataclass(frozen=True)
class Interval:
    """A ``value`` and its 95 % interval. The value is NaN if it is undefined, and the bounds may be infinite."""

    value: float
    low: float
    high: float


def mcnemar(a: ArrayLike, b: ArrayLike) -> McNemar:
    """Return the result of McNemar's exact test: is an event equally frequent with two methods in the same N cases?

    ``a``, ``b`` (N,): masks of the cases that have the event with method a, and with method b.
    """
    first, second = np.asarray(a, dtype=bool), np.asarray(b, dtype=bool)
    only_a, only_b = int(np.sum(first & ~second)), int(np.sum(second & ~first))
    uneven = only_a + only_b
    return McNemar(only_a, only_b, min(1.0, 2.0 * float(scipy.special.bdtr(min(only_a, only_b), uneven, 0.5))))


def quantile(values: ArrayLike, share: float) -> float:
    """Return a quantile of N values, which may be infinite, without interpolation between values. NaN without values.
    ``share``: probability of the quantile, such as 0.5 for the median. The method is "inverted_cdf" of numpy."""
    known = np.asarray(values, dtype=float)
    return float(np.quantile(known, share, method="inverted_cdf")) if len(known) else math.nan


def median_difference(a: ArrayLike, b: ArrayLike) -> Interval:
    """Return the median of ``a`` (N,) minus the median of ``b`` (N,), with a 95 % interval. Values may be infinite.

    ``a`` and ``b`` have a value for each of the same N cases.
    """
    return _of_medians(np.subtract, a, b, lowest=-math.inf)


def median_ratio(a: ArrayLike, b: ArrayLike) -> Interval:
    """Return the median of ``a`` (N,) divided by the median of ``b`` (N,), with a 95 % interval.

    ``a`` and ``b`` have a value, which may be 0 or infinite, for each of the same N cases.
    """
    return _of_medians(np.divide, a, b, lowest=0.0)


def _of_medians(
    compare: Callable[[NDArray[np.float64], NDArray[np.float64]], Array], a: ArrayLike, b: ArrayLike, *, lowest: float
) -> Interval:
    first, second = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if not len(first):
        return Interval(math.nan, lowest, math.inf)
    drawn = np.random.default_rng(_SEED).integers(len(first), size=(DRAWS, len(first)))
    # row 0 has the original cases, and each other row has a bootstrap draw
    cases = np.vstack((np.arange(len(first)), drawn))
    with np.errstate(invalid="ignore", divide="ignore"):
        figures = compare(np.median(first[cases], axis=1), np.median(second[cases], axis=1))
    tail = (1.0 - CONFIDENCE) / 2.0
    # a draw with two infinite medians is undefined, so that it must widen the interval at both ends
    unknown = np.isnan(figures[1:])
    low = quantile(np.where(unknown, lowest, figures[1:]), tail)
    high = quantile(np.where(unknown, math.inf, figures[1:]), 1.0 - tail)
    return Interval(float(figures[0]), low, high)
