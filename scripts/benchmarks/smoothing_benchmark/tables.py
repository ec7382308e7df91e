"""Tables of errors of cases, and of processor times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from benchmarking.report import KINDS, NOTHING, Report, ratio_text
from benchmarking.statistics import Ratio

from factorgraph_loc.evaluation.statistics import ENOUGH_LOGS
from smoothing_benchmark.cases import SMOOTHER, Case

ALIGNED = "aligned"
SHOWN = {"ekf": "EKF", "particle_filter": "particle filter"}  # names of estimators on the page


def shown(label: str) -> str:
    """Return the name of an estimator on the page."""
    return SHOWN.get(label, label)


def accuracy(report: Report, cases: Sequence[Case]) -> None:
    """Add a table of errors and ANEES of each estimator, pooled over logs, to a report."""
    aligned = any(case.error(label, ALIGNED) is not None for case in cases for label in case.labels)
    rows = [
        [
            case.name,
            shown(label),
            *(
                _text(value, digits)
                for kind in KINDS
                for value, digits in ((case.error(label, kind), 3), (case.anees(label, kind), 1))
            ),
            *([_text(case.error(label, ALIGNED), 3)] if aligned else []),
        ]
        for case in cases
        for label in case.labels
    ]
    heads = ["", "estimator", "causal [m]", "ANEES", "final [m]", "ANEES"]
    report.table([*heads, *(["final, aligned [m]"] if aligned else [])], rows)


def ratios(report: Report, cases: Sequence[Case]) -> None:
    """Add a table of the error of the smoother, divided by that of each filter, to a report. Runs are paired by log."""
    kinds = [kind for kind in (*KINDS, ALIGNED) if any(c.error(SMOOTHER, kind) is not None for c in cases)]
    rows = [
        [
            case.name,
            f"smoother / {shown(label)}",
            *(ratio_cell(case.ratio((SMOOTHER, kind), (label, kind)), len(case.logs)) for kind in kinds),
        ]
        for case in cases
        for label in case.filters
    ]
    heads = {"causal": "causal (95 %)", "final": "final (95 %)", ALIGNED: "final, aligned (95 %)"}
    report.table(["", "ratio of errors", *(heads[kind] for kind in kinds)], rows)


def times(report: Report, seconds: Mapping[tuple[str, str], float]) -> None:
    """Add a table of processor times to a report. ``seconds``: the time per minute of drive [s], by name of the case and
    estimator."""
    names = list(dict.fromkeys(name for name, _ in seconds))
    labels = list(dict.fromkeys(label for _, label in seconds))
    labels.sort(key=lambda label: label == SMOOTHER)
    rows = [[name, *(_text(seconds.get((name, label)), 2) for label in labels)] for name in names]
    report.table(["", *(f"{shown(label)} [s]" for label in labels)], rows)


def ratio_cell(ratio: Ratio | None, logs: int) -> str:
    """Return the cell of a ratio, with its interval if there are enough logs."""
    if ratio is None:
        return NOTHING
    return ratio_text(ratio)[0] if logs >= ENOUGH_LOGS else f"{ratio.value:.3f}"


def _text(value: float | None, digits: int) -> str:
    return NOTHING if value is None else f"{value:.{digits}f}"
