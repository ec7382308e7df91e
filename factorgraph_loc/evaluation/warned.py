"""Warnings about the results of runs. A warning is stored with each run, and printed once for all runs that have it."""

from collections.abc import Mapping, Sequence
from typing import Any

WARNINGS = "warnings"  # key of the warnings: a list in scores, a text with a line for each in a row
SWEEP = "sweep."  # start of the names of the columns that have the swept settings of a run
SIMULATION = "simulation"  # start of the names of swept settings of simulated logs

Row = Mapping[str, Any]  # a run: its log, estimator, seed, status and scores


def row_of(scores: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ``scores`` of a run for a row of a table. Lists are omitted, but the warnings are joined to one
    text."""
    cells = {name: value for name, value in scores.items() if not isinstance(value, list)}
    return cells | {WARNINGS: "\n".join(map(str, scores.get(WARNINGS, ()))) or None}


def by_text(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return {text of a warning: runs with this warning}, in the order of the first run of each warning."""
    concerned: dict[str, list[Row]] = {}
    for row in rows:
        for text in (row.get(WARNINGS) or "").split("\n"):
            if text:
                concerned.setdefault(text, []).append(row)
    return concerned


def lines(rows: Sequence[Row]) -> list[str]:
    """Return the text of each distinct warning of the runs. If only some of the estimators on a log have the warning,
    their names are appended."""
    texts = []
    for text, concerned in by_text(rows).items():
        logs = {row["log"] for row in concerned}
        all_of_them = dict.fromkeys(label_of(row) for row in rows if row["log"] in logs)
        some = dict.fromkeys(label_of(row) for row in concerned)
        texts.append(text if len(some) == len(all_of_them) else f"{text} ({', '.join(some)})")
    return texts


def label_of(row: Row) -> str:
    """Return the label of the estimator of a run in tables of results: its name if it has no label."""
    return str(row.get("label") or row["estimator"])
