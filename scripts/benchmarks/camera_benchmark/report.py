"""Runs that may fail, and the cells of tables that compare them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from benchmarking.ensemble import RunErrors, Series, run_errors
from benchmarking.report import Report, pooled, ratio_text, rmses, together
from benchmarking.statistics import rmse_ratio, share_in_band

from factorgraph_loc.errors import FglocError
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log

ACCURACY = (
    "causal [m]",
    "[deg]",
    "final [m]",
    "[deg]",
    "final p95 [m]",
    "ANEES causal / final",
    "inside causal / final",
)
NOTHING = "–"


@dataclass(frozen=True)
class Attempt:
    """A run: ``errors``, ``figures`` (:func:`factorgraph_loc.evaluation.metrics.score`) and ``warnings``; or its ``failure``.
    ``seen``: mean number of points in the camera's updates, NaN without any. ``events``: each text once."""

    errors: RunErrors | None
    figures: Mapping[str, Any]
    warnings: tuple[str, ...] = ()
    seen: float = math.nan
    events: tuple[str, ...] = ()
    failure: str = ""


Attempts = Mapping[int, Mapping[str, Attempt]]  # by seed, then by label


def attempt(log: Log, config: RunConfig) -> Attempt:
    """Run an estimator; a failure is a result."""
    try:
        result = run(log, config)
    except FglocError as error:
        return Attempt(None, {}, failure=str(error))
    except Exception as error:
        return Attempt(None, {}, failure=repr(error))
    freedoms = [dof for _, _, dof in result.diagnostics.nis.get("camera", [])]
    seen = sum(freedoms) / 2.0 / len(freedoms) if freedoms else math.nan
    events = tuple(dict.fromkeys(text for _, text in result.diagnostics.events))
    return Attempt(run_errors(result, log), score(result, log), result.warnings, seen, events)


def attempts(log: Log, configs: Mapping[str, RunConfig]) -> dict[str, Attempt]:
    return {label: attempt(log, config) for label, config in configs.items()}


def failures(report: Report, found: Attempts) -> None:
    """Report failed runs."""
    for seed, runs in sorted(found.items()):
        report.failed += [f"{label}, seed {seed}: {one.failure}" for label, one in runs.items() if one.failure]


def succeeded(found: Attempts, label: str) -> dict[int, RunErrors]:
    """The errors of a label, by seed."""
    return {
        seed: runs[label].errors  # type: ignore[misc]
        for seed, runs in sorted(found.items())
        if label in runs and runs[label].errors is not None
    }


def accuracy_cells(runs: Sequence[RunErrors]) -> tuple[str, ...]:
    """The cells of :data:`ACCURACY`, pooled over runs; NEES is that of a pose, 3 where covariances are right."""
    cells: list[str] = []
    for kind in ("causal", "final"):
        members: list[Series] = [getattr(one, kind) for one in runs]
        if any(np.isfinite(one.position).any() for one in members):
            position, heading = pooled(members)
            cells += [f"{position:.4f}", f"{heading:.3f}"]
        else:  # an offline estimator
            cells += [NOTHING, NOTHING]
    finals = together([one.final for one in runs])
    nees, inside = [], []
    for kind in ("causal", "final"):
        grid = stacked([getattr(one, kind) for one in runs])
        known = np.isfinite(grid).any()
        nees.append(f"{np.nanmean(grid):.2f}" if known else NOTHING)
        inside.append(f"{100 * share_in_band(grid):.0f} %" if known and len(runs) > 1 else NOTHING)
    return *cells, f"{np.percentile(finals, 95):.4f}", " / ".join(nees), " / ".join(inside)


def stacked(runs: Sequence[Series]) -> np.ndarray:
    """NEES (R, N) at the first N times, which all runs have."""
    count = min(len(one.nees) for one in runs)
    return np.stack([one.nees[:count] for one in runs])


def ratio_cell(found: Attempts, label: str, to: str, kind: str) -> tuple[str, str]:
    """Pooled position RMSE of one label by that of another with its interval, and the largest of a single log."""
    a, b = succeeded(found, label), succeeded(found, to)
    both = sorted(a.keys() & b.keys())
    first, second = ([getattr(of[seed], kind) for seed in both] for of in (a, b))
    if not both or not all(np.isfinite(one.position).any() for one in (*first, *second)):
        return NOTHING, NOTHING
    return ratio_text(rmse_ratio(rmses(first), rmses(second)))
