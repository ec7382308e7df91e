"""Common parts of the sections of benchmarks: options, parallel jobs, tables, and errors of many runs."""

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

ENOUGH = 10  # least number of trials for a confidence interval
NOTHING = "–"  # an empty cell
KINDS = ("causal", "final")
ACCURACY = (
    "causal [m]",
    "[rad]",
    "final [m]",
    "[rad]",
    "final p95 [m]",
    "ANEES causal / final",
    "inside causal / final",
)


@dataclass(frozen=True)
class Options:
    """The options of ``scripts/bench``.

    ``seeds``: the number of simulated logs of each kind. ``duration`` [s]: of simulated drives. If one of both is None, each
    section uses its default. ``jobs``: the number of parallel processes. ``out``: the folder of results.
    """

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
        """The folder of the images of rendered drives."""
        return self.out / "drives"


@dataclass
class Report:
    """The results of a section: ``lines`` of Markdown, and ``failed``, a line for each failure."""

    name: str
    options: Options
    lines: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    def say(self, text: str) -> None:
        self.lines += [text, ""]

    def table(self, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        self.lines += [_row(heads), "|" + "---|" * len(heads), *map(_row, rows)]
        self.lines.append("")

    def collect(
        self, function: Callable[..., Any], jobs: Mapping[Any, tuple[Any, ...]], workers: int | None = None
    ) -> dict[Any, Any]:
        """Call ``function`` with the arguments of each job, in parallel processes. Returns the results by the key of the job.
        Failed jobs are left out, and their errors are added to ``failed``."""
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
        """Print the progress of the section."""
        end = "\n" if done == total else ""
        print(f"\r{self.name}: {done:.0f} of {total:.0f}", end=end, file=sys.stderr, flush=True)


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _called(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    return function(*arguments)


def rmses(runs: Sequence[Series]) -> np.ndarray:
    """Return the position RMSE [m] of each run."""
    return np.array([one.position_rmse() for one in runs])


def pooled(runs: Sequence[Series]) -> tuple[float, float]:
    """Return the RMSE of position [m] and heading [rad], pooled over runs."""
    return pooled_rms(rmses(runs).tolist()), pooled_rms([one.heading_rmse() for one in runs])


def together(runs: Sequence[Series]) -> np.ndarray:
    """Return the position errors [m] of all runs at all times in one array."""
    errors = np.concatenate([one.position for one in runs])
    return np.asarray(errors[np.isfinite(errors)])


def spread_cell(runs: Sequence[Series]) -> str:
    """Return a cell with position RMSE / median / 95th percentile [m] / heading RMSE [rad] / ANEES, pooled over runs."""
    position, heading = pooled(runs)
    errors = together(runs)
    nees = np.mean([np.nanmean(one.nees) for one in runs])
    return f"{position:.3f} / {np.median(errors):.3f} / {np.percentile(errors, 95):.3f} / {heading:.3f} / {nees:.1f}"


def accuracy_cells(runs: Sequence[RunErrors]) -> tuple[str, ...]:
    """Return the cells of the columns :data:`ACCURACY`, pooled over runs. The ANEES of a pose is 3 if covariances are correct."""
    cells: list[str] = []
    nees, inside = [], []
    for kind in KINDS:
        members: list[Series] = [getattr(one, kind) for one in runs]
        grid = stacked(members)
        if not np.isfinite(grid).any():  # an offline estimator has no causal estimates
            cells += [NOTHING, NOTHING]
            nees.append(NOTHING)
            inside.append(NOTHING)
            continue
        position, heading = pooled(members)
        cells += [f"{position:.4f}", f"{heading:.5f}"]
        nees.append(f"{np.nanmean(grid):.2f}")
        inside.append(f"{100 * share_in_band(grid):.0f} %" if len(runs) > 1 else NOTHING)
    p95 = np.percentile(together([one.final for one in runs]), 95)
    return *cells, f"{p95:.4f}", " / ".join(nees), " / ".join(inside)


def ratio_cells(a: Sequence[Series], b: Sequence[Series]) -> tuple[str, str]:
    """Return two cells: the ratio of the pooled RMSEs of the runs ``a`` and ``b`` with its interval, and the largest ratio of a
    single log."""
    return ratio_text(rmse_ratio(rmses(a), rmses(b)))


def ratio_text(ratio: Ratio) -> tuple[str, str]:
    return f"{ratio.value:.3f} ({ratio.low:.3f} to {ratio.high:.3f})", f"{ratio.worst:.3f}"


def share_text(successes: int, count: int) -> str:
    """Return the text "successes of count", with a confidence interval in per cent if there are at least :data:`ENOUGH` trials."""
    low, high = wilson(successes, count)
    return f"{successes} of {count}" + (f" ({100 * low:.0f} % to {100 * high:.0f} %)" if count >= ENOUGH else "")
