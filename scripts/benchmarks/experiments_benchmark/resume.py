"""Time to detect that an experiment is finished."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
from benchmarking.report import Report

from experiments_benchmark.options import ExperimentOptions, many
from factorgraph_loc.experiments.experiment import run_experiment

AT_MOST, TRIES = 2.0, 5  # s
COMMAND = "from factorgraph_loc.cli.main import main; main()"


def section(options: ExperimentOptions) -> Report:
    report = Report("resume", options)
    prepared = many(options)
    run_experiment(prepared, jobs=options.jobs)
    rows = []
    for what, words in (
        ("`fgloc experiment run`", ["run"]),
        ("`fgloc experiment status --verify`", ["status", "--verify"]),
    ):
        command = [
            sys.executable,
            "-c",
            COMMAND,
            "experiment",
            *words,
            options.out / "many.toml",
            "-o",
            prepared.folder,
        ]
        taken = []
        for _ in range(TRIES):
            started = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            taken.append(time.perf_counter() - started)
        rows.append([what, f"{min(taken):.2f}", f"{np.median(taken):.2f}"])
    report.table((f"with {options.many_runs} finished runs", "least of 5 [s]", "median [s]"), rows)
    if float(rows[0][1]) > AT_MOST:
        report.failed.append(f"it takes more than {AT_MOST} s to find {options.many_runs} runs done")
    return report
