"""Statistical inference on the scores of many runs: pooled scores, differences, significance and effect size.

Runs are paired by log and seed. With six logs or more, intervals and tests are over logs. With a single log and six
seeds or more, they are over seeds, and are valid for this log only. Otherwise there is neither interval nor test.

Test: Wilcoxon, "Individual comparisons by ranking methods", Biometrics Bulletin 1(6), 1945, with zeros as of Pratt,
"Remarks on zeros and ties in the Wilcoxon signed rank procedures", JASA 54(287), 1959. Effect: matched-pairs
rank-biserial correlation, Kerby, "The simple difference formula", Comprehensive Psychology 3, 2014. Many comparisons:
Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6(2), 1979. Band of
the NEES: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4. Its
number of independent values: Geyer, "Practical Markov chain Monte Carlo", Statistical Science 7(4), 1992, section 3.3.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np
from scipy.special import ndtr

from factorgraph_loc.evaluation.pairing import CONFIDENCE
from factorgraph_loc.evaluation.scores import COMPARED
from factorgraph_loc.evaluation.statistics import ENOUGH_LOGS, average, bounds, draw_pooled, pair_seeds
from factorgraph_loc.evaluation.warned import Row
from factors import chi_squared
from factors.se2 import Array

SIGNIFICANT = 1.0 - CONFIDENCE  # a p value below this is significant
_EXACT = 60  # maximum number of pairs for which the signed-rank distribution is computed exactly

# columns of the table of differences and their types; the types are needed if the table is empty
DIFFERENCES: dict[str, type] = {
    **dict.fromkeys(("metric", "a", "b", "log"), str),
    **dict.fromkeys(("value_a", "value_b", "difference", "low", "high"), float),
    **dict.fromkeys(("pairs", "left_out"), int),
}

Seeds = Mapping[int, float | None]  # by seed, the score of the run, None if it has no score
ByLog = Mapping[str, Seeds]  # by log, the scores of its runs by seed
Units = Literal["logs", "seeds"]


@dataclass(frozen=True)
class Pooled:
    """A score of a method, pooled over the seeds and logs of many runs.

    ``low``, ``high``: 95 % interval of ``value``, None if there are too few units. ``units``: the independent samples
    of the statistics. They are "logs", or "seeds" for a single log. ``least``, ``most``: smallest and largest score of
    a unit. ``count``, ``logs``: numbers of units and logs.
    """

    value: float
    low: float | None
    high: float | None
    least: float
    most: float
    units: Units
    count: int
    logs: int


@dataclass(frozen=True)
class Contrast:
    """The difference between the scores of two methods a and b.

    ``difference``: pooled score of a minus that of b. ``low``, ``high``: its 95 % interval. ``p``: two-sided p value of
    the signed-rank test. ``effect``: rank-biserial correlation, -1 to 1. Interval, ``p`` and ``effect`` are None if
    there are too few units. ``units``: the independent samples of the statistics, "logs", or "seeds" for a single log.
    ``count``: number of units. ``by_log``: by log, the scores of a and of b. ``pairs``: number of compared pairs of
    runs. ``left_out``: number of runs without a run of the other method on the same log and seed.
    """

    difference: float
    low: float | None
    high: float | None
    p: float | None
    effect: float | None
    units: Units
    count: int
    by_log: dict[str, tuple[float, float]]
    pairs: int
    left_out: int


def pooled(scores: ByLog, *, rms: bool, alike: Mapping[str, str] | None = None) -> Pooled | None:
    """Return a score that is pooled over seeds, and then over logs with equal weights. Return None without scores.

    ``scores``: {log: {seed: score}}. ``rms``: whether to pool by the root mean square instead of the mean. ``alike``:
    {log: name of its group}. All logs of a group count as one log.
    """
    known = {log: np.array([[v] for v in seeds.values() if v is not None]) for log, seeds in scores.items()}
    clusters = _clusters(known, alike)
    if not clusters:
        return None
    per_log = np.array([average(cluster, rms=rms)[0] for cluster in clusters])
    units, enough = _units(clusters)
    low, high = bounds(draw_pooled(clusters, rms=rms)[:, 0]) if enough else (None, None)
    values = clusters[0] if units == "seeds" else per_log
    value = float(average(per_log[:, None], rms=rms)[0])
    return Pooled(value, low, high, float(values.min()), float(values.max()), units, len(values), len(clusters))


def contrast(
    a: ByLog, b: ByLog, *, rms: bool, interval: bool = True, alike: Mapping[str, str] | None = None
) -> Contrast | None:
    """Return the difference between the scores ``a`` and ``b`` of two methods, {log: {seed: score}}.

    Only common logs and seeds are compared. If a method ran with a single seed, its run is paired with each seed of the
    other method. ``rms``: whether to pool by the root mean square instead of the mean. ``alike``: {log: name of its
    group}; all logs of a group count as one. ``interval``: whether to compute the interval, which takes time. Returns
    None without common runs.
    """
    matched = {log: pair_seeds(a[log], b[log]) for log in a if log in b}
    left_out = sum(missing for _, missing in matched.values()) + sum(len(b[log]) for log in b if log not in a)
    left_out += sum(len(a[log]) for log in a if log not in b)
    scores = {log: both for log, (both, _) in matched.items() if len(both)}
    clusters = _clusters(scores, alike)
    if not clusters:
        return None
    per_log = np.array([average(cluster, rms=rms) for cluster in clusters])
    total = average(per_log, rms=rms)
    units, enough = _units(clusters)
    pairs = clusters[0] if units == "seeds" else per_log
    low, high, p, effect = None, None, None, None
    if enough and interval:
        drawn = draw_pooled(clusters, rms=rms)
        low, high = bounds(drawn[:, 0] - drawn[:, 1])
    if enough:
        p, effect = signed_rank(pairs[:, 0] - pairs[:, 1]), rank_biserial(pairs[:, 0] - pairs[:, 1])
    values = {log: average(both, rms=rms).tolist() for log, both in scores.items()}
    return Contrast(
        difference=float(total[0] - total[1]),
        low=low,
        high=high,
        p=p,
        effect=effect,
        units=units,
        count=len(pairs),
        by_log={log: (x, y) for log, (x, y) in values.items()},
        pairs=sum(map(len, clusters)),
        left_out=left_out,
    )


def differences(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return rows with the differences between the RMSEs of estimators ``a`` and ``b``, for all pairs and logs.

    ``rows``: runs as dictionaries with log, estimator, seed and scores. A row of the result has the keys
    :data:`DIFFERENCES`. ``value_a``, ``value_b``: RMSEs over the seeds that both ran, None without such seeds.
    ``difference``: ``value_a`` - ``value_b``. ``pairs``: number of compared pairs of runs. ``left_out``: number of runs
    without a run of the other estimator. With enough logs, a row with the log "(all)" has a 95 % interval ``low``,
    ``high``.
    """
    logs = list(dict.fromkeys(row["log"] for row in rows))
    names = list(dict.fromkeys(row["estimator"] for row in rows))
    compared: list[dict[str, Any]] = []
    for metric in COMPARED:
        scores: dict[str, dict[str, dict[int, float | None]]] = {name: {log: {} for log in logs} for name in names}
        for row in rows:
            scores[row["estimator"]][row["log"]][row["seed"]] = row.get(metric)
        for a, b in combinations(names, 2):
            lines: list[tuple[Any, ...]] = []
            for log in logs:
                both, missing = pair_seeds(scores[a][log], scores[b][log])
                values = average(both, rms=True).tolist() if len(both) else (None, None)
                lines.append((log, *values, None, None, len(both), missing))
            total = contrast(scores[a], scores[b], rms=True)
            if total is not None and total.units == "logs" and total.low is not None:
                values = average(list(total.by_log.values()), rms=True).tolist()
                lines.append(("(all)", *values, total.low, total.high, total.pairs, total.left_out))
            for log, x, y, *rest in lines:
                cells = (metric, a, b, log, x, y, None if x is None else x - y, *rest)
                compared.append(dict(zip(DIFFERENCES, cells, strict=True)))
    return compared


def signed_rank(differences: Array) -> float:
    """Return the two-sided p value of Wilcoxon's signed-rank test. The hypothesis is that ``differences`` (N,) are
    symmetric about 0.

    The p value is exact for at most 60 differences that are not 0. For more, the normal approximation is used.
    """
    ranks = _ranks(differences)
    doubled = np.rint(2.0 * ranks[differences != 0.0]).astype(
        int
    )  # the ranks of ties are multiples of 0.5, so their doubles are whole numbers
    if not len(doubled):
        return 1.0
    total = int(doubled.sum())
    positive = int(np.rint(2.0 * ranks[differences > 0.0].sum()))
    extreme = min(positive, total - positive)
    if len(doubled) > _EXACT:
        # the continuity correction of 1 / 2 is 1 here, because all rank sums are doubled
        z = (extreme + 1.0 - total / 2.0) / math.sqrt(float(np.sum(np.square(doubled.astype(float)))) / 4.0)
        return min(1.0, 2.0 * float(ndtr(z)))
    counts = np.zeros(total + 1)
    counts[0] = 1.0
    for rank in doubled.tolist():
        counts[rank:] += counts[:-rank].copy()
    return min(1.0, 2.0 * float(counts[: extreme + 1].sum() / counts.sum()))


def rank_biserial(differences: Array) -> float:
    """Return the matched-pairs rank-biserial correlation of ``differences`` (N,): 1 if all are above 0, -1 if below."""
    ranks = _ranks(differences)
    total = float(ranks[differences != 0.0].sum())
    return float(ranks[differences > 0.0].sum() - ranks[differences < 0.0].sum()) / total if total else 0.0


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Return ``p_values`` corrected for the number of tests by Holm's method. None means that a test was not made."""
    tested = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, i) in enumerate(tested):
        largest = max(largest, min(1.0, (len(tested) - rank) * p))
        corrected[i] = largest
    return corrected


def least_p(count: int) -> float:
    """Return the smallest p value that the signed-rank test can have with ``count`` differences."""
    return float(2.0 ** (1 - count))


def independent_count(values: Array) -> float:
    """Return the effective number of independent values in a time series (N,): N divided by the autocorrelation time.

    It is at least 1. Autocorrelations are summed over pairs of lags until the sum of a pair is not positive (Geyer's
    initial positive sequence).
    """
    n = len(values)
    centred = values - np.mean(values)
    power = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    covariances = np.fft.irfft(power)[:n]
    if n < 2 or covariances[0] <= 0.0:
        return 1.0
    correlations = covariances / covariances[0]
    pairs = correlations[0 : n - n % 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.0)
    time = 2.0 * float(pairs[: ends[0] if len(ends) else None].sum()) - 1.0
    return max(1.0, min(float(n), n / max(time, 1.0)))


def mean_nees_band(counts: Sequence[float], dofs: Sequence[int]) -> tuple[float, float]:
    """Return the 95 % interval of the mean NEES of a consistent estimator, averaged over each log and then over logs.

    ``counts``: by log, the effective number of independent values. ``dofs``: by log, the degrees of freedom of a pose.
    The distribution is approximated by a scaled chi-square distribution with the same mean and variance.
    """
    expected = float(np.mean(dofs))
    matched = (expected * len(dofs)) ** 2 / float(np.sum(np.asarray(dofs) / np.asarray(counts, dtype=float)))
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = expected * chi_squared.quantile((tail, 1.0 - tail), matched) / matched
    return float(low), float(high)


def _ranks(differences: Array) -> Array:
    """Return the ranks (N,) of the absolute values of ``differences`` (N,). Equal values have their mean rank. This
    avoids the slow import of ``scipy.stats.rankdata``."""
    _, which, counts = np.unique(np.abs(differences), return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - 0.5 * (counts - 1.0))[which])


def _clusters(scores: Mapping[str, Array], alike: Mapping[str, str] | None) -> list[Array]:
    """Return arrays (K, C) of the scores of K runs with C compared methods, one for each log or group of logs.
    ``scores``: by log, such an array. ``alike``: {log: name of its group}, or None for no groups. Logs of one group
    share an array."""
    merged: dict[str, list[Array]] = {}
    for log, values in scores.items():
        if len(values):
            merged.setdefault((alike or {}).get(log, log), []).append(values)
    return [np.concatenate(parts) for parts in merged.values()]


def _units(clusters: Sequence[Array]) -> tuple[Units, bool]:
    """Return the kind of independent units, "logs", or "seeds" for a single log. Also return True if there are enough
    units for intervals. ``clusters``: the scores (K, C) of the runs on each log."""
    if len(clusters) == 1:
        return "seeds", len(clusters[0]) >= ENOUGH_LOGS
    return "logs", len(clusters) >= ENOUGH_LOGS
