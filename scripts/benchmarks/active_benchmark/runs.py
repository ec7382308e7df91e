"""Runs of worlds, policies and estimators, and the tables of them."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarking.report import Options, Report

from factorgraph_loc.evaluation.figures import write_picture
from factorgraph_loc.experiments.active import jobs_of, run_jobs, write_tables
from factorgraph_loc.experiments.active_results import comparison, difference_cells, summary_cells
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.simulation import preset

WORLDS = ("office", "symmetric", "warehouse")
SETTINGS = ActiveSettings()


def compared(
    name: str,
    options: Options,
    estimators: Mapping[str, Sequence[str]],
    seeds: Sequence[int],
    text: str,
    worlds: Sequence[str] = WORLDS,
) -> Report:
    """The section ``name``: ``worlds`` and ``estimators``, each with its policies."""
    report = Report(name, options)
    jobs = [
        job
        for world in worlds
        for estimator, policies in estimators.items()
        for job in jobs_of(preset(world), policies, (estimator,), seeds, SETTINGS)
    ]
    results = run_jobs(jobs, options.out, options.jobs, lambda done, total: tell(name, done, total))
    print(file=sys.stderr)
    report.failed += results.failures
    report.say(text)
    report.table(*summary_cells(results.rows))
    if len(estimators) == 1:
        # in the dense office robots are localized almost without driving
        report.table(*difference_cells([row for row in results.rows if row["world"] != "office"]))
    folder = options.out / name
    folder.mkdir(parents=True, exist_ok=True)
    write_tables(results.rows, folder)
    write_picture(comparison(results.rows), folder / "comparison.png")
    return report


def tell(name: str, done: Any, total: Any) -> None:
    print(f"\r{name}: {done} of {total}", end="", file=sys.stderr, flush=True)


def goal(seeds: Sequence[int]) -> str:
    """The caption of every table of runs."""
    degrees = math.degrees(SETTINGS.heading_limit)
    return (
        f"{len(seeds)} robots in each world, the same for all policies. A robot gives up after {SETTINGS.max_metres:.0f} m. "
        f"*Failed*: not localized by then, with standard deviations and errors below {SETTINGS.position_limit:g} m and "
        f"{degrees:.0f} degrees. *Claimed wrongly*: localized with an error above three times that. Errors are medians at "
        "the end. Planning is the time of a step."
    )
