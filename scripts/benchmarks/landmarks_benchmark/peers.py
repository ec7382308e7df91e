"""Comparison of the estimators of this project with programs that use other packages, on one recorded log and with the same noise.

The processor time of the loop over the measurements is compared. All programs take turns, and the smallest time of each is used.
"""

from __future__ import annotations

import numpy as np
from benchmarking.report import NOTHING, Options, Report
from recorded_logs import recorded_log

from landmarks_benchmark.ours import CONFIGS, LOG, Times, least, timed_loop, timed_run
from landmarks_benchmark.problems import problem_of
from landmarks_benchmark.programs import gtsam_loops

ROUNDS = 3
HEADS = ("s", "an update [ms]", "error [m]")


def section(options: Options) -> Report:
    report = Report("peers", options)
    try:
        from landmarks_benchmark.programs import filterpy_ekf  # noqa: PLC0415 - filterpy is not a dependency
    except ImportError as error:
        report.failed.append(str(error))
        return report
    peers = (
        ("EKF", "filterpy, motion composed to each stamp", filterpy_ekf.composed),
        ("EKF", "filterpy, each row of odometry", filterpy_ekf.rows),
        ("EKF, 5 constants", "filterpy without constants", filterpy_ekf.composed),
        ("smoother, lag 10 s, 5 constants", "fixed-lag smoother in a plain loop", gtsam_loops.lag),
        ("smoother, 5 constants", "iSAM2 in a plain loop", gtsam_loops.full),
        ("smoother, full history, 5 constants", "iSAM2 in a plain loop", gtsam_loops.full),
        ("batch", "GTSAM's factors, from dead reckoning", gtsam_loops.batch),
    )
    log = recorded_log(LOG, options.data_root)
    problem = problem_of(log)
    pairs = {
        (name, what): (timed_run(log, CONFIGS[name], problem), timed_loop(loop, problem)) for name, what, loop in peers
    }
    rows = [
        (name, *cells(ours), what, *cells(other), f"{other.seconds / ours.seconds:.2f}")
        for (name, what), (ours, other) in least(pairs, ROUNDS).items()
    ]
    report.say(f"Processor time on {LOG}, the least of {ROUNDS}; an update: median / 99 %.")
    report.table(("ours", *HEADS, "elsewhere", *HEADS, "elsewhere / ours"), rows)
    return report


def cells(times: Times) -> tuple[str, str, str]:
    ms = times.update_ms
    update = f"{np.median(ms):.2f} / {np.percentile(ms, 99):.2f}" if len(ms) else NOTHING
    return f"{times.seconds:.2f}", update, f"{times.position:.3f}"
