"""Speedup with two processes, and the overhead of a run."""

from __future__ import annotations

import time

import numpy as np
from benchmarking.report import Report

from experiments_benchmark.options import ExperimentOptions, file_of, fresh
from factorgraph_loc.experiments.experiment import run_experiment

RATIO, OVERHEAD = 1.7, 0.15  # least speedup; largest overhead [s]


def section(options: ExperimentOptions) -> Report:
    report = Report("speed", options)
    file = file_of(options.out, "short", runs=options.short_runs, duration=30.0, particles=500)
    warm = file_of(options.out, "warm", runs=1, duration=30.0, particles=500)
    run_experiment(fresh(warm, options.out / "warm"))  # exclude compilation
    rows, walls = [], []
    for jobs in (1, 2):
        prepared = fresh(file, options.out / f"short-{jobs}")
        heard: list[float] = []
        started = time.perf_counter()
        table = run_experiment(
            prepared, jobs=jobs, progress=lambda *_, heard=heard: heard.append(time.perf_counter())
        ).rows
        walls.append(time.perf_counter() - started)
        own = (table["timing.causal_seconds"] + table["timing.final_seconds"]).to_numpy()
        whole = np.mean(np.diff(heard)[1:]) * jobs  # between results, in one process
        rows.append(
            [
                str(jobs),
                f"{walls[-1]:.1f}",
                f"{heard[1] - started:.1f}",
                f"{1e3 * np.mean(own):.0f}",
                f"{1e3 * (whole - np.mean(own)):.0f}",
            ]
        )
    report.table(
        ("processes", "whole [s]", "until the first result [s]", "estimator, a run [ms]", "all else, a run [ms]"), rows
    )
    report.say(f"{options.short_runs} runs: two processes are {walls[0] / walls[1]:.2f} times as fast as one.")
    if walls[0] / walls[1] < RATIO:
        report.failed.append(f"two processes are less than {RATIO} times as fast as one")
    if float(rows[0][-1]) > 1e3 * OVERHEAD:
        report.failed.append(f"a run costs more than {OVERHEAD} s beside its estimator")
    return report
