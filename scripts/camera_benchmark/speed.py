"""How long it takes; one process at a time, except where images are said to be looked at by several."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from benchmarking.report import Report

from camera_benchmark.options import CameraOptions
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.simulation import preset, simulate

POINTS = 3000  # so many that 20 are in sight nearly always
SEED = 0
WARM_UP = 20.0  # s of another drive: what is compiled at first use is no part of a step
DURATION = 300.0  # s
KNOWN: Mapping[str, Any] = {"rounds_per_second": 10.0, "pixels": {"rate": 10.0}}
KEYFRAMES: Mapping[str, Any] = {"pixels": {"rate": 2.0}}  # an image for each keyframe
NO_MAP: Mapping[str, Any] = {"landmarks": "unknown"}
ALL, SEEN = ("odometry", "rfid", "sightings"), ("odometry", "sightings")


@dataclass(frozen=True)
class Steps:
    """A run whose steps are timed: what is measured in it, the run itself, and the target [ms], median and 99 %."""

    what: str
    changes: Mapping[str, Any]
    config: RunConfig
    target: str


STEPS = (
    Steps("20 known points and all antennas, 10 Hz", KNOWN, RunConfig("smoother", {"lag": 10.0}, ALL), "0.3"),
    Steps("the same, full history", KNOWN, RunConfig("smoother", {}, ALL), ""),
    Steps("the same", KNOWN, RunConfig("ekf", {}, SEEN), ""),
    Steps("the same", KNOWN, RunConfig("particle_filter", {"smooth": False}, ALL), ""),
    Steps("20 known points, 10 Hz", KNOWN, RunConfig("monoslam", {"smooth": False}, SEEN), ""),
    Steps(
        "20 unknown points, a keyframe each", KEYFRAMES, RunConfig("smoother", {**NO_MAP, "lag": 10.0}, SEEN), "2 / 8"
    ),
    Steps("the same, full history", KEYFRAMES, RunConfig("smoother", NO_MAP, SEEN), ""),
    Steps(
        "20 unknown points, 100 in the state, 5 Hz", {}, RunConfig("monoslam", {**NO_MAP, "max_points": 100}, SEEN), "3"
    ),
)


@dataclass(frozen=True)
class Job:
    steps: Steps
    duration: float


def section(options: CameraOptions) -> Report:
    report = Report("speed", options)
    estimators(report, options.seconds(DURATION))
    return report


def estimators(report: Report, duration: float) -> None:
    jobs = [Job(steps, duration) for steps in STEPS]
    found = report.collect(timed, jobs, [f"{job.steps.what}, {job.steps.config.estimator}" for job in jobs], workers=1)
    report.say(
        f"Steps of {duration:.0f} s in `office` with identified points. A step is what comes at one time, an image with about 20 "
        "points and, where said, a round of all eight antennas, with the estimate after it. *Second half*: of the run"
    )
    rows = []
    for i, (ms, points) in sorted(found.items()):
        steps, half = jobs[i].steps, ms[len(ms) // 2 :]
        median, p99, worst = np.median(ms), np.percentile(ms, 99), ms.max()
        step = f"{median:.2f} / {p99:.2f} / {worst:.1f}"
        later = f"{np.median(half):.2f} / {np.percentile(half, 99):.2f}"
        rows.append((steps.what, steps.config.estimator, step, later, steps.target, f"{points:.1f}"))
    heads = ("what", "estimator", "median / p99 / max [ms]", "second half", "target", "points an image")
    report.table(heads, rows)


def timed(job: Job) -> tuple[np.ndarray, float]:
    """Milliseconds (M,) of each step, and how many points an image has in the mean."""
    run(simulate(preset("office", changed(job.steps, WARM_UP)), SEED + 1), job.steps.config)
    log = simulate(preset("office", changed(job.steps, job.duration)), SEED)
    _, counts = np.unique(log.streams["sightings"].t, return_counts=True)
    return run(log, job.steps.config).timings.update_ms, float(counts.mean())


def changed(steps: Steps, duration: float) -> dict[str, Any]:
    return {"world": {"tags": 20, "points": POINTS}, "drive": {"duration": duration}, **steps.changes}
