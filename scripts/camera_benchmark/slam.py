"""No map: the points that the camera sees are estimated with the poses; identified points in many worlds, images in a few."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from benchmarking.report import Report

from camera_benchmark.options import CameraOptions
from camera_benchmark.report import (
    ACCURACY,
    NOTHING,
    Attempt,
    Attempts,
    accuracy_cells,
    attempts,
    failures,
    succeeded,
)
from factorgraph_loc.evaluation.statistics import pooled_rms
from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.log import Log
from factorgraph_loc.simulation import preset, simulate

RUNS = 50
DURATION = 120.0  # s
FIRST = 5000
POINTS = 600
NO_MAP = {"landmarks": "unknown"}
TARGET = 0.15  # m
ODOMETRY = ("odometry",)
NAMED = {"sensors": ("odometry", "sightings")}
WITH_TAGS = {"sensors": ("odometry", "rfid", "sightings")}
CONFIGS = {
    "dead_reckoning": RunConfig("dead_reckoning", sensors=ODOMETRY),
    "smoother": RunConfig("smoother", NO_MAP, **NAMED),
    "batch": RunConfig("batch", NO_MAP, **NAMED),
    "monoslam": RunConfig("monoslam", NO_MAP, **NAMED),
    "smoother, with tags": RunConfig("smoother", NO_MAP, **WITH_TAGS),
}


@dataclass(frozen=True)
class Job:
    seed: int
    duration: float


def section(options: CameraOptions) -> Report:
    report = Report("slam", options)
    count, duration = options.count(RUNS), options.seconds(DURATION)
    jobs = [Job(FIRST + i, duration) for i in range(count)]
    outcomes = report.collect(named, jobs, [f"seed {job.seed}" for job in jobs])
    found = {jobs[i].seed: outcome for i, outcome in outcomes.items()}
    failures(report, found)
    report.say(
        f"Identified points: {len(found)} worlds of `office` with {POINTS} points that no map has, {duration:.0f} s each, images "
        "at 5 Hz with at most 20 points; the start is known to 0.1 m and 0.05 rad. *Aligned*: after the trajectory is laid on the "
        f"reference, which takes the error of the start away. Target: {TARGET} m"
    )
    table(report, found, CONFIGS)
    return report


def table(report: Report, found: Attempts, labels: dict[str, RunConfig]) -> None:
    rows = []
    for label in labels:
        runs = succeeded(found, label)
        if runs:
            rows.append((label, *accuracy_cells(list(runs.values())), *aligned_cells(found, label)))
    report.table(("estimator", *ACCURACY, "aligned final [m]", "[deg]"), rows)
    single = [
        (seed, label, *(one.figures.get(key) for key in FIGURES))
        for seed, runs in sorted(found.items())
        for label, one in runs.items()
    ]
    report.figures("named", ("seed", "estimator", *FIGURES), single)


FIGURES = ("causal.position_rmse", "final.position_rmse", "final.anees", "aligned.position_rmse", "landmarks.count")


def aligned_cells(found: Attempts, label: str) -> tuple[str, str]:
    runs: list[Attempt] = [runs[label] for runs in found.values() if label in runs and not runs[label].failure]
    cells = []
    for what, unit in (("position", 1.0), ("heading", 180.0 / np.pi)):
        values = [one.figures.get(f"aligned.{what}_rmse") for one in runs]
        known = [value for value in values if value is not None]
        cells.append(f"{unit * pooled_rms(known):.4f}" if known else NOTHING)
    return cells[0], cells[1]


def named(job: Job) -> dict[str, Attempt]:
    """All runs of one world with identified points."""
    return attempts(named_log(job), CONFIGS)


def named_log(job: Job) -> Log:
    world = {"tags": 20, "points": POINTS}
    return simulate(preset("office", {"world": world, "drive": {"duration": job.duration}}), job.seed)
