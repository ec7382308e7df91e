"""Cases of the comparison: runs of a smoother and of filters with the same sensors on the same logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from benchmarking.statistics import Ratio, rmse_ratio

from factorgraph_loc.evaluation.statistics import pooled_rms
from factors.se2 import Array

SMOOTHER = "smoother"
RMSE = {"causal": "causal.position_rmse", "final": "final.position_rmse", "aligned": "final.aligned_position_rmse"}


@dataclass(frozen=True)
class Case:
    """The successful runs with one set of sensors. ``name``: the title of the sensors on the page. ``rows``: the scores of each
    run."""

    name: str
    rows: Sequence[Mapping[str, Any]]

    @property
    def labels(self) -> list[str]:
        """The estimators, the smoother last."""
        found = dict.fromkeys(str(row["label"]) for row in self.rows)
        return sorted(found, key=lambda label: (label == SMOOTHER, list(found).index(label)))

    @property
    def filters(self) -> list[str]:
        """The estimators that the smoother is compared with."""
        return [label for label in self.labels if label != SMOOTHER]

    @property
    def logs(self) -> list[str]:
        """The names of the logs."""
        return list(dict.fromkeys(str(row["log"]) for row in self.rows))

    def of_logs(self) -> list[Case]:
        """Return a case for each log, with the name of the log."""
        return [Case(log, [row for row in self.rows if row["log"] == log]) for log in self.logs]

    def scores(self, label: str, score: str) -> dict[str, float]:
        """Return a score of the estimator ``label`` by log. Logs without this score are left out."""
        return {
            str(row["log"]): float(row[score])
            for row in self.rows
            if row["label"] == label and row.get(score) is not None
        }

    def error(self, label: str, kind: str) -> float | None:
        """Return the position RMSE [m], pooled over logs, or None without scores. ``kind``: "causal", "final" or "aligned"."""
        scores = self.scores(label, RMSE[kind])
        return pooled_rms(list(scores.values())) if scores else None

    def anees(self, label: str, kind: str) -> float | None:
        """Return the mean ANEES over logs, or None without scores."""
        scores = self.scores(label, f"{kind}.anees")
        return float(np.mean(list(scores.values()))) if scores else None

    def ratio(self, above: tuple[str, str], below: tuple[str, str]) -> Ratio | None:
        """Return the ratio of two position RMSEs, paired by log, or None if no log has both. ``above``, ``below``: label and
        kind."""
        a, b = (self.scores(label, RMSE[kind]) for label, kind in (above, below))
        logs = [log for log in a if log in b]
        return rmse_ratio(_of(a, logs), _of(b, logs)) if logs else None


def cases_of(rows: Sequence[Mapping[str, Any]], names: Mapping[str, str]) -> list[Case]:
    """Return the cases of an experiment. ``names``: the title of each list of sensors. The list "" means the sensors of the rig."""
    done = [row for row in rows if row["status"] == "ok"]
    return [
        Case(name, found)
        for sensors, name in names.items()
        if (found := [r for r in done if (r["sensors"] or "") == sensors])
    ]


def _of(scores: Mapping[str, float], logs: Sequence[str]) -> Array:
    return np.array([scores[log] for log in logs])
