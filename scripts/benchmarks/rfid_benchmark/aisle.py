"""Recorded reads: each of two recordings is localized with a detection model learnt from the other recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from benchmarking.ensemble import RunErrors, run_errors, series
from benchmarking.report import Options, Report, spread_cell
from benchmarking.statistics import first_held
from benchmarking.trials import HOLD, POSITION
from recorded_logs import recorded_log

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.io.native.rig_file import read_rig, write_rig
from factorgraph_loc.model.log import Log, cut
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.rfid.calibration.learn import learn_rfid

RUNS = (13, 16)
SEEDS = 3
LEARNING_SEED = 100  # seed of the simulated odometry of the log that is used for learning
PLACES = Path(__file__).parents[3] / "datasets" / "rfid-aisle-places.rig.toml"
DETECTIONS = ("odometry", "rfid")
SENSORS = {"detections": DETECTIONS, "+ RSSI": (*DETECTIONS, "rssi"), "+ phase": (*DETECTIONS, "phase")}
ESTIMATORS = ("particle_filter", "smoother")
RUN = (
    *((estimator, name) for name in ("detections", "+ phase") for estimator in ESTIMATORS),
    ("smoother", "+ RSSI"),
)
SHIPPED = ", shipped rig"
START_SPAN = 90.0  # s: length of the part of a recording that is used for an unknown start


@dataclass(frozen=True)
class Tested:
    """The results on one recording. ``runs``: errors by estimator and sensors. ``starts``: by estimator, the time [s] until the
    estimate is correct after an unknown start."""

    runs: dict[tuple[str, str], RunErrors]
    starts: dict[str, float]


def section(options: Options) -> Report:
    report = Report("aisle", options)
    learning = {("learning on run", number): (number, options.data_root, options.out / "aisle") for number in RUNS}
    rigs = {number: rig for (_, number), rig in report.collect(learnt_on, learning).items()}
    tests = {
        (number, seed): (number, seed, rigs[other], options.data_root)
        for number, other in zip(RUNS, reversed(RUNS), strict=True)
        for seed in range(min(SEEDS, options.count(SEEDS)))
        if other in rigs
    }
    outcomes: dict[tuple[int, int], Tested] = report.collect(tested, tests)
    accuracy(report, outcomes)
    unknown_starts(report, outcomes)
    return report


def accuracy(report: Report, outcomes: dict[tuple[int, int], Tested]) -> None:
    report.say(
        f"The cells combine both recordings, with {len(outcomes) // len(RUNS)} odometry seeds each. *Shipped rig*: "
        "`datasets/rfid-aisle.rig.toml`, learnt on both recordings. The cells are RMSE / median / p95 [m] / heading RMSE [rad] / "
        "ANEES."
    )
    rows = []
    for key in dict.fromkeys(key for outcome in outcomes.values() for key in outcome.runs):
        members = [outcome.runs[key] for outcome in outcomes.values()]
        rows.append((*key, *(spread_cell([getattr(one, kind) for one in members]) for kind in ("causal", "final"))))
    report.table(("estimator", "sensors", "causal", "final"), rows)


def unknown_starts(report: Report, outcomes: dict[tuple[int, int], Tested]) -> None:
    report.say(
        "The next table is for an unknown start and detections. It has the time from the first scan until the error is below "
        f"{POSITION} m for {HOLD:.0f} s, for each odometry seed."
    )
    rows = []
    for estimator in ESTIMATORS:
        for number in RUNS:
            seconds = [outcome.starts[estimator] for (run, _), outcome in outcomes.items() if run == number]
            if seconds:
                cells = ", ".join("never" if np.isnan(s) else f"{s:.0f}" for s in seconds)
                rows.append((f"run {number}", estimator, cells, f"{max(seconds):.0f}"))
    report.table(("run", "estimator", "by seed [s]", "longest [s]"), rows)


def aisle(number: int, seed: int, data_root: Path | None) -> Log:
    """Return the log of a recording. ``seed``: that of its simulated odometry."""
    return recorded_log(f"rfid-aisle-run{number}", data_root, seed)


def learnt_on(number: int, data_root: Path | None, out: Path) -> Rig:
    """Learn a rig from one recording, starting at the surveyed antennas. Its tempering is that of the shipped rig."""
    log = aisle(number, LEARNING_SEED, data_root)
    assert log.rig.rfid is not None
    out.mkdir(parents=True, exist_ok=True)
    name = f"learnt-on-run{number}"
    given = read_rig(PLACES)
    sections = dict(learn_rfid([log], given, out / name).sections)
    sections["rfid"] = sections["rfid"].model_copy(update={"tempering": log.rig.rfid.tempering})
    rig = given.model_copy(update=sections)
    write_rig(rig, out / f"{name}.rig.toml")
    return rig


def tested(number: int, seed: int, rig: Rig, data_root: Path | None) -> Tested:
    """Run all estimators on one recording with one seed of the odometry."""
    log = aisle(number, seed, data_root)
    shipped = log.rig
    log = replace(log, rig=rig)
    runs = {("dead_reckoning", "odometry"): run_errors(run(log, RunConfig("dead_reckoning")), log)}
    for estimator, name in RUN:
        runs[estimator, name] = run_errors(run(log, RunConfig(estimator, sensors=SENSORS[name])), log)
    for name in ("detections", "+ phase"):
        config = RunConfig("smoother", sensors=SENSORS[name])
        runs["smoother", name + SHIPPED] = run_errors(run(replace(log, rig=shipped), config), log)
    starts = {estimator: seconds_to_right(log, estimator, seed) for estimator in ESTIMATORS}
    return Tested(runs, starts)


def seconds_to_right(log: Log, estimator: str, seed: int) -> float:
    """Return the time [s] from the first scan until the error remains below half a metre. The status of the estimate is ignored."""
    start = cut(log, 0.0, START_SPAN)
    result = run(start, RunConfig(estimator, sensors=DETECTIONS, prior="unknown", seed=seed))
    errors = series(Trajectory(result.t, result.poses, result.covariances), start)
    return first_held(errors.t, errors.position < POSITION, HOLD) - float(start.streams["rfid"].t[0])
