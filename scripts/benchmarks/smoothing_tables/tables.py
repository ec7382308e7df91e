"""Tables of cases, and of their processor times."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from benchmarking.statistics import Ratio

from factorgraph_loc.evaluation.statistics import ENOUGH_LOGS
from smoothing_tables.cases import SMOOTHER, Case

NOTHING = "–"
KINDS = ("causal", "final")
ALIGNED = "aligned"
SHOWN = {"ekf": "EKF", "particle_filter": "particle filter"}  # as they are called in the text

Lines = Iterator[str]


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Lines:
    """A table in Markdown, and an empty line."""
    yield from (f"| {' | '.join(cells)} |" for cells in (heads, ["---"] * len(heads), *rows))
    yield ""


def shown(label: str) -> str:
    """The name of an estimator on the page."""
    return SHOWN.get(label, label)


def accuracy(cases: Sequence[Case]) -> Lines:
    """Errors and ANEES of each estimator, pooled over logs."""
    aligned = any(case.error(label, ALIGNED) is not None for case in cases for label in case.labels)
    rows = [
        [
            case.name,
            shown(label),
            *(cell for kind in KINDS for cell in (_error(case.error(label, kind)), _anees(case.anees(label, kind)))),
            *([_error(case.error(label, ALIGNED))] if aligned else []),
        ]
        for case in cases
        for label in case.labels
    ]
    heads = ["", "estimator", "causal [m]", "ANEES", "final [m]", "ANEES"]
    yield from table([*heads, *(["final, aligned [m]"] if aligned else [])], rows)


def ratios(cases: Sequence[Case]) -> Lines:
    """The error of the smoother over that of each filter, paired by log."""
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
    yield from table(["", "ratio of errors", *(heads[kind] for kind in kinds)], rows)


def times(seconds: Mapping[tuple[str, str], float]) -> Lines:
    """Processor time [s per minute of drive] by name of the case and estimator."""
    names = list(dict.fromkeys(name for name, _ in seconds))
    labels = list(dict.fromkeys(label for _, label in seconds))
    labels.sort(key=lambda label: label == SMOOTHER)
    rows = [[name, *(_seconds(seconds.get((name, label))) for label in labels)] for name in names]
    yield from table(["", *(f"{shown(label)} [s]" for label in labels)], rows)


def ratio_cell(ratio: Ratio | None, logs: int) -> str:
    """A ratio, with its interval where there are enough logs for one."""
    if ratio is None:
        return NOTHING
    return f"{ratio.value:.3f} ({ratio.low:.3f} to {ratio.high:.3f})" if logs >= ENOUGH_LOGS else f"{ratio.value:.3f}"


def _error(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.3f}"


def _anees(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.1f}"


def _seconds(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.2f}"
