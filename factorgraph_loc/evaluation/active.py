"""Summaries and paired comparisons of active localization runs, policy by policy on the same seeds.

A run that failed or did not end localized counts with an infinite distance.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from factorgraph_loc.evaluation.paired import Interval, mcnemar, median_difference, median_ratio, quantile
from factorgraph_loc.fitting.shares import wilson
from factors.se2 import Array

Row = Mapping[str, Any]
Case = tuple[str, str]  # world, estimator

# columns of a difference, with their types, as there may be no rows
DIFFERENCES: dict[str, type] = {
    **dict.fromkeys(("world", "estimator", "a", "b"), str),
    "pairs": int,
    **dict.fromkeys(("difference", "low", "high", "ratio", "ratio_low", "ratio_high"), float),
    **dict.fromkeys(("failed_only_a", "failed_only_b"), int),
    "p": float,
}
NEVER = "never"


def cases(rows: Sequence[Row]) -> list[Case]:
    """World and estimator of the runs, in order of appearance."""
    return list(dict.fromkeys((row["world"], row["estimator"]) for row in rows))


def policies(rows: Sequence[Row]) -> list[str]:
    """The policies of the runs, in order of appearance."""
    return list(dict.fromkeys(row["policy"] for row in rows))


def runs_of(rows: Sequence[Row], case: Case, policy: str) -> list[Row]:
    """The runs of one world, estimator and policy."""
    return [row for row in rows if (row["world"], row["estimator"]) == case and row["policy"] == policy]


def metres(rows: Sequence[Row]) -> Array:
    """Metres driven until localized (N,), infinite for runs that never were."""
    return np.array([row["metres"] if row["localized"] else math.inf for row in rows], dtype=float)


def summaries(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Statistics for each world, estimator and policy.

    ``runs``; ``median`` and 90th percentile ``p90`` of the metres until localized; ``failures`` and their 95 % interval;
    ``claimed_wrong``: runs that at some time claimed wrongly to be localized; median errors ``error_position`` [m] and
    ``error_heading`` [rad] and median ``seconds`` (simulated) of those that ended localized; ``planning_ms``: median over runs of
    the median time of a planning step."""
    found = []
    for case in cases(rows):
        for policy in policies(rows):
            runs = runs_of(rows, case, policy)
            if not runs:
                continue
            driven = metres(runs)
            ended = [row for row in runs if row["localized"]]
            failures = len(runs) - len(ended)
            low, high = wilson(failures, len(runs))
            found.append(
                {
                    "world": case[0],
                    "estimator": case[1],
                    "policy": policy,
                    "runs": len(runs),
                    "median": float(np.median(driven)),
                    "p90": quantile(driven, 0.9),
                    "failures": failures,
                    "failures_low": low,
                    "failures_high": high,
                    "claimed_wrong": sum(bool(row["claimed_wrong"]) for row in runs),
                    **{key: _median(ended, key) for key in ("error_position", "error_heading", "seconds")},
                    "planning_ms": _median(runs, "planning_ms"),
                }
            )
    return found


def differences(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The first policy ``a`` compared with each other one ``b``, on common seeds, for each world and estimator.

    ``difference`` [m] of the medians, a minus b, with 95 % interval ``low`` to ``high``; their ``ratio``, a over b, with its
    interval; the numbers of seeds ``failed_only_a`` and ``failed_only_b``, and ``p`` of McNemar's exact test for equal failure
    rates.
    """
    found = []
    first, *others = policies(rows)
    for case in cases(rows):
        ours = {row["seed"]: row for row in runs_of(rows, case, first)}
        for other in others:
            theirs = {row["seed"]: row for row in runs_of(rows, case, other)}
            seeds = sorted(ours.keys() & theirs.keys())
            if not seeds:
                continue
            a, b = (metres([of[seed] for seed in seeds]) for of in (ours, theirs))
            difference, ratio = median_difference(a, b), median_ratio(a, b)
            failed = mcnemar(np.isinf(a), np.isinf(b))
            values = (
                *(*case, first, other, len(seeds)),
                *(difference.value, difference.low, difference.high, ratio.value, ratio.low, ratio.high),
                *(failed.only_a, failed.only_b, failed.p),
            )
            found.append(dict(zip(DIFFERENCES, values, strict=True)))
    return found


def summary_cells(rows: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the table of :func:`summaries`."""
    header = ["world", "policy", "estimator", "runs", "median [m]", "90 % [m]", "failed (95 %)", "claimed wrongly"]
    header += ["error [m]", "[deg]", "time [s]", "planning [ms]"]
    lines = []
    for one in summaries(rows):
        low, high = 100.0 * one["failures_low"], 100.0 * one["failures_high"]
        lines.append(
            [
                *(one["world"], one["policy"], one["estimator"], str(one["runs"])),
                *(metres_text(one["median"]), metres_text(one["p90"])),
                f"{one['failures']} ({low:.0f} % to {high:.0f} %)",
                str(one["claimed_wrong"]),
                *(_text(one["error_position"], 2), _text(np.degrees(one["error_heading"]), 1)),
                *(_text(one["seconds"], 0), _text(one["planning_ms"], 1)),
            ]
        )
    return header, lines


def difference_cells(rows: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the table of :func:`differences`."""
    header = ["world", "policies", "estimator", "pairs", "difference [m] (95 %)", "ratio (95 %)"]
    header += ["failed only first / second", "p (McNemar)"]
    lines = []
    for one in differences(rows):
        difference = Interval(one["difference"], one["low"], one["high"])
        ratio = Interval(one["ratio"], one["ratio_low"], one["ratio_high"])
        lines.append(
            [
                *(one["world"], f"{one['a']} / {one['b']}", one["estimator"], str(one["pairs"])),
                *(_interval_text(difference, 1), _interval_text(ratio, 2)),
                *(f"{one['failed_only_a']} / {one['failed_only_b']}", f"{one['p']:.3f}"),
            ]
        )
    return header, lines


def metres_text(value: float) -> str:
    return NEVER if math.isinf(value) else _text(value, 1)


def _interval_text(interval: Interval, digits: int) -> str:
    value, low, high = (_text(bound, digits) for bound in (interval.value, interval.low, interval.high))
    return f"{value} ({low} to {high})"


def _text(value: float, digits: int) -> str:
    if math.isnan(value):
        return "–"
    return ("∞" if value > 0 else "-∞") if math.isinf(value) else f"{value:.{digits}f}"


def _median(rows: Sequence[Row], key: str) -> float:
    known = [row[key] for row in rows if row[key] is not None]
    return float(np.median(known)) if known else math.nan
