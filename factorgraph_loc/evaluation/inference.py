"""Statistical inference on the scores of many runs: pooled figures, differences, significance and effect size.

Runs are paired by log and seed, and logs are the units: with six logs or more there is an interval and a test over logs. With one
log and six seeds or more both are over its seeds, and hold for this log only. In between, the results of each log are listed
without a test.

Test: Wilcoxon, "Individual comparisons by ranking methods", Biometrics Bulletin 1(6), 1945, with zeros as of Pratt, "Remarks on
zeros and ties in the Wilcoxon signed rank procedures", JASA 54(287), 1959. Effect: matched-pairs rank-biserial correlation,
Kerby, "The simple difference formula", Comprehensive Psychology 3, 2014. Many comparisons: Holm, "A simple sequentially rejective
multiple test procedure", Scandinavian Journal of Statistics 6(2), 1979. Band of the NEES: Bar-Shalom, Li, Kirubarajan,
"Estimation with Applications to Tracking and Navigation", 2001, section 5.4. Its number of independent values: Geyer,
"Practical Markov chain Monte Carlo", Statistical Science 7(4), 1992, section 3.3.
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

SIGNIFICANT = 1.0 - CONFIDENCE
_EXACT = 60  # largest number of pairs with an exact distribution

# columns of a difference, with their types, as there may be no rows
DIFFERENCES: dict[str, type] = {
    **dict.fromkeys(("metric", "a", "b", "log"), str),
    **dict.fromkeys(("value_a", "value_b", "difference", "low", "high"), float),
    **dict.fromkeys(("pairs", "left_out"), int),
}

Seeds = Mapping[int, float | None]  # the score of each seed, None where a run has none
ByLog = Mapping[str, Seeds]
Units = Literal["logs", "seeds"]


@dataclass(frozen=True)
class Pooled:
    """A figure over logs. ``low`` and ``high``: 95 % interval over ``units``, None if these are too few; ``least`` and ``most``:
    the range over its ``count`` units, which are the logs, or the seeds of a single log."""

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
    """``a`` minus ``b``: negative if the scores of ``a`` are lower.

    ``difference`` of the pooled figures, with 95 % interval ``low`` to ``high``; ``p`` (two-sided) and ``effect`` (-1 to 1) of
    the signed-rank test. Interval and test are over ``count`` ``units``, None if these are too few. ``by_log``: both figures of
    each log, (value_a, value_b). ``pairs``: number of runs compared; ``left_out``: number without a partner.
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
    """A figure pooled over seeds, then over logs with equal weight: root mean square, or else the mean. None without any.

    ``alike``: for logs that are variations of one, its name; together they count as one log.
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
    """Compare two sets of runs by their common logs and seeds; None if they have none in common.

    One that ran with one seed is paired with each seed of the other. ``interval``: whether to compute the interval, which takes
    time. ``alike``: see :func:`pooled`; ``by_log`` lists these logs separately.
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
    """Differences ``a`` minus ``b`` of the RMSEs of all pairs of estimators: negative if ``a`` is better.

    ``rows`` are runs with log, estimator, seed and scores. For each log: RMSE pooled over the pairs of seeds. With enough logs
    for an interval also ``log`` = "(all)". ``pairs``: number of compared (log, seed); ``left_out``: number without a score in one
    of the two. Without any pair the values are None.
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
    """Two-sided p of Wilcoxon's signed-rank test that differences (N,) are symmetric about 0; exact up to 60."""
    ranks = _ranks(differences)
    doubled = np.rint(2.0 * ranks[differences != 0.0]).astype(int)  # ranks of ties are multiples of a half
    if not len(doubled):
        return 1.0
    total = int(doubled.sum())
    positive = int(np.rint(2.0 * ranks[differences > 0.0].sum()))
    extreme = min(positive, total - positive)
    if len(doubled) > _EXACT:
        # the continuity correction is half a step of the rank sum, which is doubled here
        z = (extreme + 1.0 - total / 2.0) / math.sqrt(float(np.sum(np.square(doubled.astype(float)))) / 4.0)
        return min(1.0, 2.0 * float(ndtr(z)))
    counts = np.zeros(total + 1)
    counts[0] = 1.0
    for rank in doubled.tolist():
        counts[rank:] += counts[:-rank].copy()
    return min(1.0, 2.0 * float(counts[: extreme + 1].sum() / counts.sum()))


def rank_biserial(differences: Array) -> float:
    """Matched-pairs rank-biserial correlation of differences (N,): 1 if all are positive, -1 if all are negative."""
    ranks = _ranks(differences)
    total = float(ranks[differences != 0.0].sum())
    return float(ranks[differences > 0.0].sum() - ranks[differences < 0.0].sum()) / total if total else 0.0


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Holm's corrected p values: those below 0.05 are significant together. None is not tested, and stays."""
    tested = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, i) in enumerate(tested):
        largest = max(largest, min(1.0, (len(tested) - rank) * p))
        corrected[i] = largest
    return corrected


def least_p(count: int) -> float:
    """The smallest p that :func:`signed_rank` can return for ``count`` differences."""
    return float(2.0 ** (1 - count))


def independent_count(values: Array) -> float:
    """The effective number of independent values in a series (N,): N over its integrated autocorrelation time, at least 1.

    Autocorrelations are summed over pairs of lags until a pair is no longer positive (Geyer's initial positive sequence).
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
    """The 95 % band of a consistent estimator's mean NEES, averaged over logs.

    ``counts``: effective number of independent values of each log; ``dofs``: its degrees of freedom. The band is that of a
    chi-square distribution with the same mean and variance."""
    expected = float(np.mean(dofs))
    matched = (expected * len(dofs)) ** 2 / float(np.sum(np.asarray(dofs) / np.asarray(counts, dtype=float)))
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = expected * chi_squared.quantile((tail, 1.0 - tail), matched) / matched
    return float(low), float(high)


def _ranks(differences: Array) -> Array:
    """Ranks of the absolute values, equal ones sharing theirs; zeros get the lowest and count for neither side. As
    ``scipy.stats.rankdata``, which takes half a second to import."""
    _, which, counts = np.unique(np.abs(differences), return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - 0.5 * (counts - 1.0))[which])


def _clusters(scores: Mapping[str, Array], alike: Mapping[str, str] | None) -> list[Array]:
    """The scores (K, C) of each log that has any, with those of ``alike`` logs merged."""
    merged: dict[str, list[Array]] = {}
    for log, values in scores.items():
        if len(values):
            merged.setdefault((alike or {}).get(log, log), []).append(values)
    return [np.concatenate(parts) for parts in merged.values()]


def _units(clusters: Sequence[Array]) -> tuple[Units, bool]:
    """The statistical units, and whether there are enough."""
    if len(clusters) == 1:
        return "seeds", len(clusters[0]) >= ENOUGH_LOGS
    return "logs", len(clusters) >= ENOUGH_LOGS
