"""Rendered offices with a map from another drive: every estimator with every sensor that it uses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmarking.report import Report

from camera_benchmark.drives import MAP_DURATION, MAP_RATE, RATE, TAGS, Drive, log_of, map_of, with_map
from camera_benchmark.options import CameraOptions
from camera_benchmark.report import (
    ACCURACY,
    NOTHING,
    Attempt,
    Attempts,
    accuracy_cells,
    attempts,
    failures,
    ratio_cell,
    succeeded,
)
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
TARGETS = "final of the smoother with all sensors 0.05 m, 0.5 degrees, p95 0.10 m or less; `switching` 3 times as far off or more"
FIGURES = tuple(f"{kind}.{what}_rmse" for kind in ("causal", "final") for what in ("position", "heading"))


@dataclass(frozen=True)
class Job:
    drive: Drive
    folder: Path
    configs: dict[str, RunConfig]


@dataclass(frozen=True)
class Outcome:
    """``runs`` by label; number of ``points`` in the map."""

    runs: dict[str, Attempt]
    points: int


def section(options: CameraOptions) -> Report:
    report = Report("office", options)
    count, duration = options.count(SEEDS), options.seconds(DURATION)
    jobs = [
        Job(Drive(FIRST + i, FIRST + i, duration), options.drives, CONFIGS | (SLOW if i < SLOW_SEEDS else {}))
        for i in range(count)
    ]
    outcomes = report.collect(localized, jobs, [f"seed {job.drive.seed}" for job in jobs])
    found = {jobs[i].drive.seed: outcome.runs for i, outcome in outcomes.items()}
    failures(report, found)
    points = [outcome.points for outcome in outcomes.values()]
    if points:
        report.say(
            f"{len(found)} rendered offices with {TAGS} tags, {duration:.0f} s each, {RATE:.0f} images/s. The map of each has "
            f"{min(points)} to {max(points)} points. It is learnt from another drive of {MAP_DURATION:.0f} s with {MAP_RATE:.0f} "
            f"images/s, whose poses are off by 0.02 m and 0.01 rad. Targets: {TARGETS}."
        )
    accuracy(report, found)
    comparisons(report, found)
    single = [
        (seed, label, *(one.figures.get(key) for key in FIGURES))
        for seed, runs in sorted(found.items())
        for label, one in runs.items()
    ]
    report.figures("runs", ("seed", "run", *FIGURES), single)
    return report


def accuracy(report: Report, found: Attempts) -> None:
    rows = []
    for label, config in (CONFIGS | SLOW).items():
        runs = list(succeeded(found, label).values())
        if runs:
            name = label.partition(",")[0]
            rows.append((name, NAMES[config.sensors or ()], str(len(runs)), *accuracy_cells(runs)))
    report.table(("estimator", "sensors", "runs", *ACCURACY), rows)


def comparisons(report: Report, found: Attempts) -> None:
    report.say(
        "Final position RMSE over that of the smoother with all sensors, with a 95 % interval over the offices, and the largest "
        "ratio of one office."
    )
    rows = []
    for label in (*CONFIGS, *SLOW):
        if label == BEST or not succeeded(found, label):
            continue
        rows.append((label, *ratio_cell(found, label, BEST, "final")))
    report.table(("run", "ratio (95 %)", "largest"), rows)


def localized(job: Job) -> Outcome:
    """All runs on one drive; jobs can be sent to other processes."""
    log, _ = log_of(job.drive, job.folder)
    points = map_of(job.drive, job.folder)
    return Outcome(attempts(with_map(log, points), job.configs), len(points))
