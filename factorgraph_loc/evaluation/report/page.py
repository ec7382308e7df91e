"""The report of an experiment as one HTML file, with the configuration that is needed to repeat the experiment.

The text of the page is in ``drawing/templates/report.html``. This module computes the values that the text contains.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl
import tomli_w

from factorgraph_loc.drawing.pages import render
from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.report import plots, tables
from factorgraph_loc.evaluation.report.results import Results, Runs, read_runs, score
from factorgraph_loc.evaluation.scores import REPORT, TIMINGS, Metric, metric_of
from factorgraph_loc.evaluation.warned import WARNINGS
from factorgraph_loc.files.models import write_text

SHOWN = 8  # maximum number of variants with trajectories that are visible initially
_SWEPT = 3  # maximum number of metrics that are plotted over a swept setting


def write_report(
    rows: pl.DataFrame,
    runs: Runs,
    out: Path,
    *,
    metrics: Sequence[str] = REPORT,
    baseline: str | None = None,
    title: str = "Results",
    experiment: Mapping[str, Any] | None = None,
    damaged: Sequence[str] = (),
    versions: Mapping[str, str] | None = None,
) -> None:
    """Write a report about runs as an HTML page. ``out``: path of the page. ``title``: heading of the page.

    ``rows``: a row for each run, with key, log, estimator, seed, status (ok, failed), reason and scores. Optional
    columns are label, sensors, kind (of a failure), warnings and ``sweep.*``. ``runs``: a function that returns the
    result files of a run by its key, and the map of its log or None. ``metrics``: keys of the scores to show.
    ``baseline``: label of the runs with which all other runs are compared. If it is None or no run has it, the first
    label is used. ``experiment``: content of the experiment file. ``damaged``: descriptions of runs with unusable
    results. ``versions``: version of each used software by name.

    Raises InputError if there are no rows.
    """
    if not len(rows):
        raise InputError(f"there are no runs to report on{f' ({len(damaged)} are damaged)' if damaged else ''}")
    results = Results(rows)
    labels = {label: name for name, label in reversed(results.variants.items())}
    reference = labels.get(baseline or "", next(iter(results.variants)))
    shown = _scored_metrics(results, metrics)
    values = _row_variables(results, shown, reference) | _file_variables(results, shown[0].key, runs)
    asked = tomli_w.dumps(_toml(experiment)) if experiment else ""
    sections = {
        "results": "Results",
        "differences": f"Differences from {reference}" if len(results.variants) > 1 else "",
        "by-log": "Log by log",
        "trajectories": "Trajectories and errors over time" if values["tracks"] else "",
        "distributions": "Distribution of errors" if values["distributions"] else "",
        "sweeps": "Sweeps" if values["sweeps"] else "",
        "consistency": "Consistency" if values["consistency"] else "",
        "times": "Times" if values["first_time"] else "",
        "warnings": "Warnings" if values["warned"] else "",
        "failures": "Failures" if values["failed"] else "",
        "repeat": "To repeat it",
        "method": "Statistics",
    }
    sections = {identity: name for identity, name in sections.items() if name}
    page = render(
        "report.html",
        title=title,
        sections=sections,
        results=results,
        asked=asked,
        damaged=damaged,
        versions=versions or {},
        p_value=tables.p_value,
        uncertainty=tables.uncertainty,
        **values,
    )
    write_text(out, page)


def _row_variables(results: Results, metrics: Sequence[Metric], baseline: str) -> dict[str, Any]:
    """Return the variables of the HTML template that depend only on the table of runs. ``baseline``: name of the
    variant with which the others are compared."""
    best = [results.compare(metric) for metric in metrics]
    against = [results.compare(metric, baseline) for metric in metrics]
    times = _scored_metrics(results, tuple(TIMINGS), whole=False)
    return {
        "metrics": metrics,
        "baseline": baseline,
        "best": best,
        "overview": tables.overview(results, best),
        "differences": tables.differences(results, against),
        "by_log": {metric.heading: tables.by_log(results, metric) for metric in metrics},
        "cautions": tables.cautions(results, best),
        "seeds": len({row["seed"] for row in results.rows}),
        "failed": sum(row["status"] != "ok" for row in results.rows),
        "failures": tables.failures(results),
        "warnings": tables.warnings(results),
        "warned": sum(bool(row.get(WARNINGS)) for row in results.rows),
        "ratios": plots.ratios(results, against),
        "sweeps": plots.sweeps(results, metrics[:_SWEPT]),
        "times": tables.timing(results, times),
        "first_time": plots.times(results, times[0]) if times else None,
    }


def _file_variables(results: Results, metric: str, runs: Runs) -> dict[str, Any]:
    """Return the variables of the HTML template that are read from the files of the runs. ``metric``: the trajectory of
    each variant and log is from the seed with the median of this score."""
    read = read_runs(results, metric, runs)
    return {
        "tracks": read.tracks,
        "viewer": {"variants": list(results.variants), "logs": list(read.tracks), "shown": SHOWN},
        "distributions": plots.distributions(results, read.errors),
        "consistency": plots.consistency(results, read.trust, read.nees),
        "overconfident": [v for v, (mean, _, high) in read.trust.items() if mean > high],
        "underconfident": [v for v, (mean, low, _) in read.trust.items() if mean < low],
        "consistent": [v for v, (mean, low, high) in read.trust.items() if low <= mean <= high],
        "configs": read.configs,
    }


def _scored_metrics(results: Results, keys: Sequence[str], *, whole: bool = True) -> list[Metric]:
    """Return the metrics with the given ``keys`` that have a score in at least one run. If there are none: return all
    metrics if ``whole`` is true, otherwise an empty list."""
    known = [metric_of(k) for k in keys if any(score(row, k) is not None for row in results.rows)]
    return known or ([metric_of(k) for k in keys] if whole else [])


def _toml(content: Any) -> Any:
    """Return nested ``content`` without the values that are None, because TOML has no such value."""
    if isinstance(content, Mapping):
        return {str(key): _toml(value) for key, value in content.items() if value is not None}
    if isinstance(content, list | tuple):
        return [_toml(value) for value in content if value is not None]
    return content if isinstance(content, str | int | float | bool) else str(content)
