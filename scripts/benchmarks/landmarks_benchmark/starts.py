"""Unknown starts and kidnappings on recorded logs."""

from __future__ import annotations

import numpy as np
from benchmarking.report import NOTHING, Options, Report
from benchmarking.trials import TRIALS_OF, run_trials
from recorded_logs import recorded_log

LOGS = ("mrclam6-robot1", "mrclam6-robot3", "mrclam6-robot5", "woods-r5")
TRIALS = 20
HEADS = ("", "log", "estimator", "right", "false claims", "median time [s]", "failed at [s]")


def section(options: Options) -> Report:
    report = Report("starts", options)
    logs = {name: recorded_log(name, options.data_root) for name in LOGS}
    jobs = {
        (kind, name, estimator): (kind, logs[name], estimator, options.count(TRIALS))
        for kind in TRIALS_OF
        for estimator in ("smoother", "particle_filter")
        for name in LOGS
    }
    rows = []
    for key, trials in report.collect(run_trials, jobs).items():
        # by the time offsets of the rig, the first estimate may be slightly before the start: the time is then 0
        median = max(0.0, np.nanmedian([trial.seconds for trial in trials]))
        at = ", ".join(f"{trial.t:.0f}" for trial in trials if not trial.right) or NOTHING
        right, false = (sum(getattr(trial, what) for trial in trials) for what in ("right", "false"))
        rows.append((*key, f"{right} of {len(trials)}", str(false), f"{median:.1f}", at))
    report.table(HEADS, rows)
    return report
