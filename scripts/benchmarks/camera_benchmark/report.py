"""Runs that may fail, and cells of tables that compare their errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from benchmarking.ensemble import RunErrors, run_errors
from benchmarking.report import Report

from factorgraph_loc.errors import FglocError
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log


@dataclass(frozen=True)
class Attempt:
    """The outcome of a run.

    ``errors``: None if the run failed. ``figures``: its scores (:func:`factorgraph_loc.evaluation.metrics.score`).
    ``failure``: the error message of a failed run, otherwise empty.
    """

    errors: RunErrors | None
    figures: Mapping[str, Any]
    failure: str = ""


Attempts = Mapping[int, Mapping[str, Attempt]]  # by seed, then by label


def attempt(log: Log, config: RunConfig) -> Attempt:
    """Run an estimator on a log. An exception is caught and becomes the ``failure`` of the outcome."""
    try:
        result = run(log, config)
    except FglocError as error:
        return Attempt(None, {}, failure=str(error))
    except Exception as error:
        return Attempt(None, {}, failure=repr(error))
    return Attempt(run_errors(result, log), score(result, log))


def attempts(log: Log, configs: Mapping[str, RunConfig]) -> dict[str, Attempt]:
    return {label: attempt(log, config) for label, config in configs.items()}


def failures(report: Report, found: Attempts) -> None:
    """Add a line for each failed run to ``report.failed``."""
    for seed, runs in sorted(found.items()):
        report.failed += [f"{label}, seed {seed}: {one.failure}" for label, one in runs.items() if one.failure]


def succeeded(found: Attempts, label: str) -> dict[int, RunErrors]:
    """Return the errors of the successful runs with a ``label``, by seed."""
    return {
        seed: runs[label].errors  # type: ignore[misc]
        for seed, runs in sorted(found.items())
        if label in runs and runs[label].errors is not None
    }
