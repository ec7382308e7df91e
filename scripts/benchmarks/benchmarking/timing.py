"""Computing times of runs on one log, measured in one process at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from benchmarking.report import NOTHING, Report
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log, cut
from factorgraph_loc.model.result import Timings

WARM_UP = 20.0  # s: the first part of the log is run before, so that compilation is not measured
HEADS = (
    "estimator",
    "update median / p99 / max [ms]",
    "first / last quarter median [ms]",
    "times real time",
    "final [s]",
    "peak memory [MB]",
)


def times_table(report: Report, load: Callable[[], Log], configs: Mapping[str, RunConfig]) -> None:
    """Measure the times of runs, and add a table of them to a report. ``load``: returns the log. ``configs``: the runs by label."""
    jobs = {label: (load, config) for label, config in configs.items()}
    found: Mapping[str, Timings] = report.collect(timed, jobs, workers=1)
    rows = []
    for label, times in found.items():
        ms, quarter = times.update_ms, len(times.update_ms) // 4
        cells = (NOTHING, NOTHING, NOTHING)
        if configs[label].estimator != "batch":
            update = f"{np.median(ms):.2f} / {np.percentile(ms, 99):.2f} / {ms.max():.2f}"
            quarters = f"{np.median(ms[:quarter]):.2f} / {np.median(ms[-quarter:]):.2f}"
            cells = (update, quarters, f"{times.real_time_factor:.0f}")
        rows.append((label, *cells, f"{times.final_seconds:.1f}", f"{times.peak_memory_mb:.0f}"))
    report.table(HEADS, rows)


def timed(load: Callable[[], Log], config: RunConfig) -> Timings:
    """Return the times of a run on the log that ``load`` returns."""
    log = load()
    first = log.span()[0]
    run(cut(log, first, first + WARM_UP), config)
    return run(log, config).timings
