"""Common parts of the sections: options, parallel jobs, tables, statistics of many runs."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarking.ensemble import Series
from benchmarking.statistics import Ratio, rmse_ratio
from factorgraph_loc.errors import FglocError
from factorgraph_loc.evaluation.statistics import pooled_rms
from factorgraph_loc.fitting.shares import wilson
from factorgraph_loc.processes import run_each

ENOUGH = 10  # trials for an interval of a share


@dataclass(frozen=True)
class Options:
    """``seeds``: number of simulated logs of each kind, None for each section's default; ``jobs``: parallel processes."""

    seeds: int | None
    jobs: int
    data_root: Path | None
    out: Path

    def count(self, usual: int) -> int:
        return usual if self.seeds is None else self.seeds


@dataclass
class Report:
    """The Markdown of a section, and its failures."""

    name: str
    options: Options
    lines: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    def say(self, text: str) -> None:
        self.lines += [text, ""]

    def table(self, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        self.lines += [f"| {' | '.join(cells)} |" for cells in (heads, ["---"] * len(heads), *rows)]
        self.lines.append("")

    def figures(self, name: str, heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        """Write results of single runs as CSV beside the report."""
        folder = self.options.out / self.name
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([heads, *rows])

    def collect(
        self, function: Callable[[Any], Any], jobs: Sequence[Any], labels: Sequence[str], workers: int | None = None
    ) -> dict[int, Any]:
        """The results of the successful jobs, by index."""
        found: dict[int, Any] = {}
        for i, outcome in run_each(function, jobs, self.options.jobs if workers is None else workers):
            if isinstance(outcome, Exception):
                self.failed.append(f"{labels[i]}: {outcome}")
                if not isinstance(outcome, FglocError):
                    print(f"{labels[i]}: {outcome!r}", file=sys.stderr)
            else:
                found[i] = outcome
            print(f"\r{self.name}: {len(found)} of {len(jobs)}", end="", file=sys.stderr, flush=True)
        print(file=sys.stderr)
        return found


def rmses(runs: Sequence[Series]) -> np.ndarray:
    """Position RMSE of each run."""
    return np.array([one.position_rmse() for one in runs])


def pooled(runs: Sequence[Series]) -> tuple[float, float]:
    """Position [m] and heading [degrees] RMSE, pooled over runs."""
    return pooled_rms(rmses(runs).tolist()), float(np.degrees(pooled_rms([one.heading_rmse() for one in runs])))


def together(runs: Sequence[Series]) -> np.ndarray:
    """The position errors of all times of all runs."""
    errors = np.concatenate([one.position for one in runs])
    return np.asarray(errors[np.isfinite(errors)])


def spread_cell(runs: Sequence[Series]) -> str:
    """RMSE / median / p95 [m] / heading RMSE [degrees] / ANEES over runs."""
    position, heading = pooled(runs)
    errors = together(runs)
    nees = np.mean([np.nanmean(one.nees) for one in runs])
    return f"{position:.3f} / {np.median(errors):.3f} / {np.percentile(errors, 95):.3f} / {heading:.1f} / {nees:.1f}"


def ratio_cells(a: Sequence[Series], b: Sequence[Series]) -> tuple[str, str]:
    """The ratio of pooled RMSEs with its interval, and the worst of a single log."""
    return ratio_text(rmse_ratio(rmses(a), rmses(b)))


def ratio_text(ratio: Ratio) -> tuple[str, str]:
    return f"{ratio.value:.3f} ({ratio.low:.3f} to {ratio.high:.3f})", f"{ratio.worst:.3f}"


def share_text(successes: int, count: int) -> str:
    """A count, with its interval in per cent if there are at least :data:`ENOUGH`."""
    low, high = wilson(successes, count)
    return f"{successes} of {count}" + (f" ({100 * low:.0f} % to {100 * high:.0f} %)" if count >= ENOUGH else "")
