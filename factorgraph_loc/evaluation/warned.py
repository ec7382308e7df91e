"""Warnings about results: stored with the scores of a run and in its row, and printed once for all runs concerned."""

from collections.abc import Mapping, Sequence
from typing import Any

WARNINGS = "warnings"  # key of the scores (a list), and of a row (one text, one line each; None without any)
SWEEP = "sweep."  # columns of rows: the swept settings of a run
SIMULATION = "simulation"  # first word of swept settings of simulated logs

Row = Mapping[str, Any]


def row_of(scores: Mapping[str, Any]) -> dict[str, Any]:
    """The scores of a run as cells of a row: lists are omitted, except for the warnings, which become one text."""
    cells = {name: value for name, value in scores.items() if not isinstance(value, list)}
    return cells | {WARNINGS: "\n".join(map(str, scores.get(WARNINGS, ()))) or None}


def by_text(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The runs concerned by each warning, in order of appearance."""
    concerned: dict[str, list[Row]] = {}
    for row in rows:
        for text in (row.get(WARNINGS) or "").split("\n"):
            if text:
                concerned.setdefault(text, []).append(row)
    return concerned


def lines(rows: Sequence[Row]) -> list[str]:
    """Each warning once, with the estimators concerned unless these are all that ran on the logs."""
    texts = []
    for text, concerned in by_text(rows).items():
        logs = {row["log"] for row in concerned}
        all_of_them = dict.fromkeys(label_of(row) for row in rows if row["log"] in logs)
        some = dict.fromkeys(label_of(row) for row in concerned)
        texts.append(text if len(some) == len(all_of_them) else f"{text} ({', '.join(some)})")
    return texts


def label_of(row: Row) -> str:
    """The label of the estimator in the results."""
    return str(row.get("label") or row["estimator"])
