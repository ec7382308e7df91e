"""The distance that a robot drives until it is localized, for each policy and estimator: runs and tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from benchmarking.report import Options, Report

from factorgraph_loc.evaluation.figures import write_picture
from factorgraph_loc.experiments.active import active
from factorgraph_loc.experiments.active_results import comparison, difference_cells, summary_cells
from factorgraph_loc.planning.settings import ActiveSettings

WORLDS = ("office", "symmetric", "warehouse")
POLICIES = ("information", "random", "patrol", "nearest_tags", "paper_literal")
ESTIMATORS = ("active_mcl", "particle_filter", "smoother")
SETTINGS = ActiveSettings()


def policies(options: Options) -> Report:
    """Compare all policies in three worlds, with the estimator ActiveMCL."""
    report = Report("policies", options)
    degrees = math.degrees(SETTINGS.heading_limit)
    report.say(
        f"A robot gives up after {SETTINGS.max_metres:.0f} m. The limits of a localized robot are "
        f"{SETTINGS.position_limit:g} m and {degrees:.0f} degrees. Errors are medians at the end. *Planning* is the time of "
        "one step."
    )
    rows = compared(report, ("active_mcl",), POLICIES, WORLDS, options.count(200))
    # in the dense office robots are localized almost without driving
    table(report, *difference_cells([row for row in rows if row["world"] != "office"]))
    return report


def estimators(options: Options) -> Report:
    """Compare three policies in the corridors, with each estimator."""
    report = Report("estimators", options)
    compared(report, ESTIMATORS, POLICIES[:3], ("symmetric",), options.count(10))
    return report


def compared(
    report: Report, estimators: Sequence[str], policies: Sequence[str], worlds: Sequence[str], count: int
) -> list[dict[str, Any]]:
    """Run all combinations, and add their summary to the report. Returns a row of scores per run. ``count``: runs per
    combination."""
    options, folder = report.options, report.options.out / report.name
    rows: list[dict[str, Any]] = []
    for world in worlds:
        done = active(
            world,
            folder / world,
            policies=policies,
            estimators=estimators,
            seeds=range(count),
            jobs=options.jobs,
            overwrite=True,
            progress=report.tell,
        )
        report.failed += done.failures
        rows += done.rows
    report.say(f"Each policy has the same {count} robots in each world.")
    table(report, *summary_cells(rows))
    write_picture(comparison(rows), folder / "comparison.png")
    return rows


def table(report: Report, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Add a table to the report, without the column ``estimator`` if all rows have the same."""
    column = list(heads).index("estimator")
    omitted = {column} if len({row[column] for row in rows}) == 1 else set[int]()
    heads, *rows = ([cell for i, cell in enumerate(cells) if i not in omitted] for cells in (heads, *rows))
    report.table(heads, rows)
