"""What is compared: the runs of a smoother and of filters, with the same measurements of the same logs."""

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
    """Successful runs with one set of sensors. ``name``: of the sensors on the page; ``rows``: the scores of a run each."""

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
        """A case for each log, named by it."""
        return [Case(log, [row for row in self.rows if row["log"] == log]) for log in self.logs]

    def scores(self, label: str, score: str) -> dict[str, float]:
        """A score of an estimator by log, where there is one."""
        return {
            str(row["log"]): float(row[score])
            for row in self.rows
            if row["label"] == label and row.get(score) is not None
        }

    def error(self, label: str, kind: str) -> float | None:
        """Position RMSE [m], pooled over logs; ``kind`` is causal, final or aligned. None without scores."""
        scores = self.scores(label, RMSE[kind])
        return pooled_rms(list(scores.values())) if scores else None

    def anees(self, label: str, kind: str) -> float | None:
        """ANEES, the mean over logs; None without scores."""
        scores = self.scores(label, f"{kind}.anees")
        return float(np.mean(list(scores.values()))) if scores else None

    def ratio(self, above: tuple[str, str], below: tuple[str, str]) -> Ratio | None:
        """The ratio of position RMSEs, each of a label and a kind, paired by log. None without a log that has both."""
        a, b = (self.scores(label, RMSE[kind]) for label, kind in (above, below))
        logs = [log for log in a if log in b]
        return rmse_ratio(_of(a, logs), _of(b, logs)) if logs else None


def cases_of(rows: Sequence[Mapping[str, Any]], names: Mapping[str, str]) -> list[Case]:
    """The cases of an experiment; ``names`` by list of sensors, or by "" where the runs have those of the rig."""
    done = [row for row in rows if row["status"] == "ok"]
    return [
        Case(name, found)
        for sensors, name in names.items()
        if (found := [r for r in done if (r["sensors"] or "") == sensors])
    ]


def _of(scores: Mapping[str, float], logs: Sequence[str]) -> Array:
    return np.array([scores[log] for log in logs])
