"""Faults of RFID installations, one at a time: their effect on the errors and on the status of the estimates."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from benchmarking.ensemble import RunErrors, run_ensemble
from benchmarking.report import Options, Report, pooled

from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.model.log import Log
from factorgraph_loc.simulation.settings import preset
from factors import se2

SEEDS = 5
FIRST = 2000
DURATION = 300.0  # s
CONFIGS = {"particle filter": RunConfig("particle_filter"), "smoother": RunConfig("smoother")}
ELSEWHERE = (3.0, math.radians(60.0))  # m, rad


def start_elsewhere(log: Log, seed: int) -> Log:
    """Return the log with an error of 3 m and 60 degrees in its stated start, in a direction that depends on ``seed``. The
    covariance of the start is unchanged."""
    assert log.start is not None
    distance, turn = ELSEWHERE
    direction, sign = 2.4 * seed, 1.0 if seed % 2 else -1.0
    pose = log.start.pose + np.array((distance * math.cos(direction), distance * math.sin(direction), sign * turn))
    pose[2] = se2.wrap_scalar(float(pose[2]))
    return replace(log, start=replace(log.start, pose=pose))


START = "start 3 m and 60 degrees off"
FAULTS: dict[str, dict[str, Any]] = {  # settings of the simulation
    "none": {},
    "20 % false reads": {"false_reads": 0.2},
    "10 % of tags 1 m off": {"misplaced": 0.1, "misplaced_by": 1.0},
    "all tags silent for 60 s": {"silence": {"time": 120.0, "duration": 60.0}},
    "an antenna stops": {"antenna_stop": {"antenna": "1", "time": 100.0}},
    "an antenna reads nothing, rounds go on": {"antenna_stop": {"antenna": "1", "time": 100.0, "rounds_go_on": True}},
    "reader's clock jumps by 0.5 s": {"clock_jump": {"time": 150.0, "jump": 0.5}},
    "20 % of tags dead": {"dead": 0.2},
    "no tag of the map is ever read": {"dead": 1.0},
    START: {},
}


def section(options: Options) -> Report:
    report = Report("faults", options)
    count = options.count(SEEDS)
    jobs = {}
    for fault, changes in FAULTS.items():
        settings = preset("office", {"drive": {"duration": DURATION}, "faults": changes})
        for seed in range(FIRST, FIRST + count):
            jobs[fault, seed] = (settings, seed, CONFIGS, *([start_elsewhere] if fault == START else []))
    outcomes = report.collect(run_ensemble, jobs)
    report.say(
        f"The table combines {count} worlds of `office`, {DURATION:.0f} s each. "
        "*Status*: share of the time at which the status is localized / ambiguous / unlocalized. "
        "Causal estimates are scored from the first `localized` on."
    )
    rows = []
    for estimator in CONFIGS:
        for fault in FAULTS:
            runs = [runs[estimator] for (name, _), runs in outcomes.items() if name == fault]
            if runs:
                rows.append((fault, estimator, *cells(runs)))
    report.table(("fault", "estimator", "causal [m] / [rad]", "worst [m]", "final [m] / [rad]", "status [%]"), rows)
    return report


def cells(runs: list[RunErrors]) -> tuple[str, str, str, str]:
    causal, final = (
        "{:.3f} / {:.3f}".format(*pooled([getattr(one, kind) for one in runs])) for kind in ("causal", "final")
    )
    worst = max(one.causal.position_rmse() for one in runs)
    shares = (
        100.0 * sum(one.share(status) for one in runs) / len(runs)
        for status in ("localized", "ambiguous", "unlocalized")
    )
    return causal, f"{worst:.3f}", final, " / ".join(f"{share:.0f}" for share in shares)
