"""Rendered offices with a map from another drive: each estimator, with each set of sensors that it can use."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarking.report import ACCURACY, NOTHING, Options, Report, accuracy_cells

from camera_benchmark.drives import MAP_DURATION, MAP_RATE, RATE, TAGS, Drive, log_of, map_of, with_map
from camera_benchmark.report import Attempt, Attempts, attempts, failures, succeeded
from factorgraph_loc.experiments.run import RunConfig

SEEDS = 20
SLOW_SEEDS = 6  # for slow estimators; the minimum for an interval
DURATION = 600.0  # s
FIRST = 7000
RFID, CAMERA, BOTH = ("odometry", "rfid"), ("odometry", "camera"), ("odometry", "rfid", "camera")
NAMES = {("odometry",): NOTHING, RFID: "rfid", CAMERA: "camera", BOTH: "rfid, camera"}
BEST, RULE = "smoother, rfid, camera", "switching, rfid, camera"
CONFIGS = {
    "dead_reckoning": RunConfig("dead_reckoning", sensors=("odometry",)),
    "particle_filter, rfid": RunConfig("particle_filter", sensors=RFID),
    "smoother, rfid": RunConfig("smoother", sensors=RFID),
    "ekf, camera": RunConfig("ekf", sensors=CAMERA),
    "monoslam, camera": RunConfig("monoslam", sensors=CAMERA),
    "smoother, camera": RunConfig("smoother", sensors=CAMERA),
    RULE: RunConfig("switching", sensors=BOTH),
    BEST: RunConfig("smoother", sensors=BOTH),
    "smoother of 10 s, rfid, camera": RunConfig("smoother", {"lag": 10.0}, sensors=BOTH),
    "batch, rfid, camera": RunConfig("batch", sensors=BOTH),
}
SLOW = {"particle_filter, rfid, camera": RunConfig("particle_filter", sensors=BOTH)}


def section(options: Options) -> Report:
    report = Report("office", options)
    count, duration = options.count(SEEDS), options.seconds(DURATION)
    jobs = {
        ("seed", FIRST + i): (
            Drive(FIRST + i, FIRST + i, duration),
            options.drives,
            CONFIGS | (SLOW if i < SLOW_SEEDS else {}),
        )
        for i in range(count)
    }
    outcomes = report.collect(localized, jobs)
    found = {seed: runs for (_, seed), (runs, _) in outcomes.items()}
    failures(report, found)
    points = [count for _, count in outcomes.values()]
    if points:
        report.say(
            f"The {len(found)} rendered offices have {TAGS} tags. Drives have {duration:.0f} s with {RATE:.0f} "
            "images/s. The maps have "
            f"{min(points)} to {max(points)} points. They are learnt from another drive of {MAP_DURATION:.0f} s with "
            f"{MAP_RATE:.0f} "
            f"images/s, whose poses have errors of 0.02 m and 0.01 rad."
        )
    accuracy(report, found)
    return report


def accuracy(report: Report, found: Attempts) -> None:
    rows = []
    for label, config in (CONFIGS | SLOW).items():
        runs = list(succeeded(found, label).values())
        if runs:
            name = label.partition(",")[0]
            rows.append((name, NAMES[config.sensors or ()], str(len(runs)), *accuracy_cells(runs)))
    report.table(("estimator", "sensors", "runs", *ACCURACY), rows)


def localized(drive: Drive, folder: Path, configs: Mapping[str, RunConfig]) -> tuple[dict[str, Attempt], int]:
    """Run all configurations on one drive. Returns the outcomes by label, and the number of points in the map."""
    points = map_of(drive, folder)
    return attempts(with_map(log_of(drive, folder), points), configs), len(points)
