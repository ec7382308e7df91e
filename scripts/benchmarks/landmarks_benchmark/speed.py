"""Computing times of estimators on one log, and the time to start the command line."""

from __future__ import annotations

import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
from benchmarking.report import Options, Report
from benchmarking.timing import times_table
from recorded_logs import recorded_log

from factorgraph_loc.experiments.run import RunConfig
from landmarks_benchmark.ours import LOG

RUNS = {
    "ekf": RunConfig("ekf"),
    "smoother": RunConfig("smoother"),
    "smoother, full history": RunConfig("smoother", {"lag": "all"}),
    "smoother, lag 10 s": RunConfig("smoother", {"lag": 10.0}),
    "particle filter, 5,000": RunConfig("particle_filter", {"particles": 5000}),
}
STARTS = 5  # of fgloc


def section(options: Options) -> Report:
    report = Report("speed", options)
    times_table(report, partial(recorded_log, LOG, options.data_root), RUNS)
    command = [str(Path(sys.executable).with_name("fgloc")), "--help"]
    seconds = []
    for _ in range(STARTS):
        started = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        seconds.append(time.perf_counter() - started)
    report.say(f"The median time of `fgloc --help` is {np.median(seconds):.2f} s of {STARTS}.")
    return report
