"""Comparison of features in the same rendered offices, in the map and in the images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from benchmarking.report import Report

from camera_benchmark.drives import COUNT, Drive, keep_features, log_of, map_of, with_map
from camera_benchmark.office import BEST, CONFIGS, FIRST
from camera_benchmark.options import CameraOptions
from camera_benchmark.report import ACCURACY, Attempt, accuracy_cells, attempts, failures, succeeded
from factorgraph_loc.sensors.camera.stream import FeatureStream

SEEDS = 4
DURATION = 300.0  # s
FEATURES = ("colour", "sift", "orb")
RUNS = ("smoother, camera", BEST)


@dataclass(frozen=True)
class Job:
    drive: Drive
    folder: Path


@dataclass(frozen=True)
class Outcome:
    """``runs`` by label; number of ``points`` in the map, of features per image, and of features ``matched`` with the map;
    milliseconds per image."""

    runs: dict[str, Attempt]
    points: int
    features: float
    matched: float
    find_ms: float
    follow_ms: float


def section(options: CameraOptions) -> Report:
    report = Report("features", options)
    count, duration = options.count(SEEDS), options.seconds(DURATION)
    jobs = [Job(Drive(FIRST + i, FIRST + i, duration), options.drives) for i in range(count)]
    outcomes = report.collect(localized, jobs, [f"seed {job.drive.seed}" for job in jobs])
    report.say(
        f"{count} rendered offices of {duration:.0f} s, as above, with each feature, at most {COUNT} in an image. *Matched*: "
        "points of the map that an image shows. Times are those of one core, with the other one busy"
    )
    accuracy, counts = [], []
    for feature in FEATURES:
        of_feature = {jobs[i].drive.seed: by_feature[feature] for i, by_feature in outcomes.items()}
        found = {seed: outcome.runs for seed, outcome in of_feature.items()}
        failures(report, found)
        for label in RUNS:
            runs = list(succeeded(found, label).values())
            if runs:
                accuracy.append((feature, label, *accuracy_cells(runs)))
        if of_feature:
            means = [
                np.mean([getattr(one, what) for one in of_feature.values()])
                for what in ("points", "features", "matched", "find_ms", "follow_ms")
            ]
            counts.append((feature, *(f"{value:.0f}" for value in means[:3]), *(f"{value:.1f}" for value in means[3:])))
    report.table(("feature", "run", *ACCURACY), accuracy)
    report.table(("feature", "points in the map", "features", "matched", "to find [ms]", "to follow [ms]"), counts)
    return report


def localized(job: Job) -> dict[str, Outcome]:
    """Both runs on one drive with each feature, detected in the same images."""
    drives = {feature: replace(job.drive, feature=feature) for feature in FEATURES}
    for variants in (list(drives.values()), [drive.mapping() for drive in drives.values()]):
        keep_features(variants, job.folder)
    return {feature: with_feature(drive, job.folder) for feature, drive in drives.items()}


def with_feature(drive: Drive, folder: Path) -> Outcome:
    log, seconds = log_of(drive, folder)
    points = map_of(drive, folder)
    runs = attempts(with_map(log, points), {label: CONFIGS[label] for label in RUNS})
    stream = log.streams["camera"]
    assert isinstance(stream, FeatureStream)
    return Outcome(
        runs,
        len(points),
        float(np.mean([len(frame.pixels) for frame in stream.frame])),
        runs[RUNS[0]].seen,
        1e3 * seconds.find / len(stream.t),
        1e3 * seconds.follow / len(stream.t),
    )
