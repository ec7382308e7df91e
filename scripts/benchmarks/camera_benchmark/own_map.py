"""Rendered offices in which one drive makes a map, without a reference or any other, and another is localized in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from benchmarking.report import Report

from camera_benchmark.drives import MAP_RATE, RATE, Drive, log_of
from camera_benchmark.options import CameraOptions
from camera_benchmark.report import ACCURACY, Attempt, accuracy_cells, attempts, failures, succeeded
from camera_benchmark.slam import FIRST_RENDERED, NO_MAP, RENDERED_DURATION, RENDERED_RUNS
from factorgraph_loc.experiments.output import map_of
from factorgraph_loc.experiments.run import RunConfig, run

AGAIN, DURATION = 500, 120.0  # added to the seed of the drive that makes the map; s
CAMERA = ("odometry", "camera")
ESTIMATORS = ("ekf", "particle_filter", "smoother", "monoslam")
FIGURES = ("causal.position_rmse", "final.position_rmse", "causal.anees", "final.anees")


@dataclass(frozen=True)
class Job:
    """A drive that makes the map, and one after it."""

    first: Drive
    second: Drive
    folder: Path


@dataclass(frozen=True)
class Outcome:
    """``runs`` by estimator; number of ``points`` in the map."""

    runs: dict[str, Attempt]
    points: int


def section(options: CameraOptions) -> Report:
    report = Report("own_map", options)
    count, duration = min(options.count(RENDERED_RUNS), RENDERED_RUNS), options.seconds(RENDERED_DURATION)
    jobs = []
    for seed in range(FIRST_RENDERED, FIRST_RENDERED + count):
        second = Drive(seed, seed + AGAIN, min(DURATION, duration), MAP_RATE)
        jobs.append(Job(Drive(seed, seed, duration, everywhere=True), second, options.drives))
    outcomes = report.collect(localized, jobs, [f"seed {job.first.seed}" for job in jobs])
    found = {jobs[i].first.seed: outcome.runs for i, outcome in outcomes.items()}
    failures(report, found)
    if outcomes:
        report.say(
            f"{len(found)} rendered offices; a drive of {duration:.0f} s, {RATE:.0f} images/s, makes the map of each, on average "
            f"of {np.mean([outcome.points for outcome in outcomes.values()]):.0f} points, in which another one of "
            f"{jobs[0].second.duration:.0f} s, {MAP_RATE:.0f} images/s, is localized. The start of both is known to 0.1 m and 0.05 "
            "rad."
        )
    rows = []
    for name in ESTIMATORS:
        if runs := list(succeeded(found, name).values()):
            rows.append((name, *accuracy_cells(runs)))
    report.table(("estimator", *ACCURACY), rows)
    single = [
        (seed, name, *(one.figures.get(key) for key in FIGURES))
        for seed, runs in sorted(found.items())
        for name, one in runs.items()
    ]
    report.figures("own_map", ("seed", "estimator", *FIGURES), single)
    return report


def localized(job: Job) -> Outcome:
    """The runs of the second drive in the map of the first."""
    log = log_of(job.first, job.folder)[0]
    world = map_of(run(log, RunConfig("smoother", NO_MAP, CAMERA)), log)
    if world is None or world.points is None:
        return Outcome({}, 0)
    later = replace(log_of(job.second, job.folder)[0], world=world)
    return Outcome(attempts(later, {name: RunConfig(name, sensors=CAMERA) for name in ESTIMATORS}), len(world.points))
