"""Runs that may fail, and the cells of tables that compare them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from benchmarking.ensemble import RunErrors, run_errors
from benchmarking.report import NOTHING, Report, ratio_cells

from factorgraph_loc.errors import FglocError
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log
from factorgraph_loc.text import Notice


@dataclass(frozen=True)
class Attempt:
    """A run: ``errors``, ``figures`` (:func:`factorgraph_loc.evaluation.metrics.score`) and ``warnings``; or its ``failure``.
    ``events``: the text of each, without its time."""

    errors: RunErrors | None
    figures: Mapping[str, Any]
    warnings: tuple[Notice, ...] = ()
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
    events = tuple(f"{e.kind}: {e.fields['why']}" if "why" in e.fields else str(e) for e in result.diagnostics.events)
    return Attempt(run_errors(result, log), score(result, log), result.warnings, events)


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


def ratio_cell(found: Attempts, label: str, to: str, kind: str) -> tuple[str, str]:
    """Pooled position RMSE of one label by that of another with its interval, and the largest of a single log."""
    a, b = succeeded(found, label), succeeded(found, to)
    both = sorted(a.keys() & b.keys())
    first, second = ([getattr(of[seed], kind) for seed in both] for of in (a, b))
    if not both or not all(np.isfinite(one.position).any() for one in (*first, *second)):
        return NOTHING, NOTHING
    return ratio_cells(first, second)
