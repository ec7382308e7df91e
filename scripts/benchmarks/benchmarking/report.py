"""Common parts of the sections: options, parallel jobs, tables, errors of many runs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarking.ensemble import RunErrors, Series, stacked
from benchmarking.statistics import Ratio, rmse_ratio, share_in_band
from factorgraph_loc.errors import FglocError
from factorgraph_loc.evaluation.statistics import pooled_rms
from factorgraph_loc.fitting.shares import wilson
from factorgraph_loc.processes import run_each

ENOUGH = 10  # trials for an interval of a share
NOTHING = "–"
KINDS = ("causal", "final")
ACCURACY = (
    "causal [m]",
    "[deg]",
    "final [m]",
    "[deg]",
    "final p95 [m]",
    "ANEES causal / final",
    "inside causal / final",
)


@dataclass(frozen=True)
class Options:
    """``seeds``: number of simulated logs of each kind, ``duration`` [s]: of simulated drives, None for each section's default;
    ``jobs``: parallel processes."""

    seeds: int | None
    jobs: int
    data_root: Path | None
    out: Path
    duration: float | None = None

    def count(self, usual: int) -> int:
        return usual if self.seeds is None else self.seeds

    def seconds(self, usual: float) -> float:
        return usual if self.duration is None else self.duration

    @property
    def drives(self) -> Path:
        """The folder of rendered drives."""
        return self.out / "drives"


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

    def collect(
        self, function: Callable[..., Any], jobs: Mapping[Any, tuple[Any, ...]], workers: int | None = None
    ) -> dict[Any, Any]:
        """The results of ``function`` for the arguments of each job, by the key of the job, without those that failed."""
        keys, found = list(jobs), dict[Any, Any]()
        call = partial(_called, function)
        for i, outcome in run_each(call, list(jobs.values()), workers or self.options.jobs):
            if isinstance(outcome, Exception):
                label = keys[i] if isinstance(keys[i], str) else ", ".join(map(str, keys[i]))
                self.failed.append(f"{label}: {outcome}")
                if not isinstance(outcome, FglocError):
                    print(f"{label}: {outcome!r}", file=sys.stderr)
            else:
                found[keys[i]] = outcome
            self.tell(len(found), len(jobs))
        return {key: found[key] for key in keys if key in found}

    def tell(self, done: float, total: float) -> None:
        """Print how much is done."""
        end = "\n" if done == total else ""
        print(f"\r{self.name}: {done:.0f} of {total:.0f}", end=end, file=sys.stderr, flush=True)


def _called(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    return function(*arguments)


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


def accuracy_cells(runs: Sequence[RunErrors]) -> tuple[str, ...]:
    """The cells of :data:`ACCURACY`, pooled over runs; NEES is that of a pose, 3 where covariances are right."""
    cells: list[str] = []
    nees, inside = [], []
    for kind in KINDS:
        members: list[Series] = [getattr(one, kind) for one in runs]
        grid = stacked(members)
        if not np.isfinite(grid).any():  # an offline estimator
            cells += [NOTHING, NOTHING]
            nees.append(NOTHING)
            inside.append(NOTHING)
            continue
        position, heading = pooled(members)
        cells += [f"{position:.4f}", f"{heading:.3f}"]
        nees.append(f"{np.nanmean(grid):.2f}")
        inside.append(f"{100 * share_in_band(grid):.0f} %" if len(runs) > 1 else NOTHING)
    p95 = np.percentile(together([one.final for one in runs]), 95)
    return *cells, f"{p95:.4f}", " / ".join(nees), " / ".join(inside)


def ratio_cells(a: Sequence[Series], b: Sequence[Series]) -> tuple[str, str]:
    """The ratio of pooled RMSEs with its interval, and the worst of a single log."""
    return ratio_text(rmse_ratio(rmses(a), rmses(b)))


def ratio_text(ratio: Ratio) -> tuple[str, str]:
    return f"{ratio.value:.3f} ({ratio.low:.3f} to {ratio.high:.3f})", f"{ratio.worst:.3f}"


def share_text(successes: int, count: int) -> str:
    """A count, with its interval in per cent if there are at least :data:`ENOUGH`."""
    low, high = wilson(successes, count)
    return f"{successes} of {count}" + (f" ({100 * low:.0f} % to {100 * high:.0f} %)" if count >= ENOUGH else "")
