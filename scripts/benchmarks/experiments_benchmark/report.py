"""Time to make the report of many runs, and its size."""

from __future__ import annotations

import time

from benchmarking.report import Report

from experiments_benchmark.options import ExperimentOptions, many
from factorgraph_loc.experiments.experiment import run_experiment
from factorgraph_loc.experiments.reporting import report_experiment

SECONDS, BYTES = 20.0, 10e6  # limits


def section(options: ExperimentOptions) -> Report:
    report = Report("report", options)
    prepared = many(options)
    run_experiment(prepared, jobs=options.jobs)
    prepared = many(options)  # with the present states
    started = time.perf_counter()
    page = report_experiment(prepared)
    taken, size = time.perf_counter() - started, page.stat().st_size
    runs = f"{options.many_runs} runs, of one estimator on one short log"
    report.say(f"The page of {runs}, is made in {taken:.1f} s and has {size / 1e6:.1f} MB.")
    if taken > SECONDS or size > BYTES:
        report.failed.append(f"the page takes more than {SECONDS:.0f} s or {BYTES / 1e6:.0f} MB")
    return report
