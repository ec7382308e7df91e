"""SLAM by a camera: points are estimated together with the poses. Named points are used in many worlds, rendered images in a
few."""

from __future__ import annotations

from pathlib import Path

from benchmarking.report import ACCURACY, NOTHING, Options, Report, accuracy_cells

from camera_benchmark.drives import RATE, TAGS, Drive, log_of
from camera_benchmark.frame import FrameKnown, frame_known, sentence
from camera_benchmark.report import Attempt, Attempts, attempts, failures, succeeded
from factorgraph_loc.evaluation.statistics import pooled_rms
from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.simulation import preset, simulate
from factorgraph_loc.simulation.settings import SimulationSettings

RUNS, DURATION = 50, 120.0  # with named points: number of drives, and their duration [s]
RENDERED_RUNS, RENDERED_DURATION = 5, 300.0  # with images: number of drives, and their duration [s]
FIRST, FIRST_RENDERED = 5000, 7000  # first seeds; those of images are the same as in the section office
POINTS = 600
NO_MAP = {"landmarks": "unknown"}
ODOMETRY = ("odometry",)


def configs(seen: str) -> dict[str, RunConfig]:
    """Return the runs by label. ``seen``: the name of the camera's sensor, "camera" or "sightings"."""
    return {
        "dead_reckoning": RunConfig("dead_reckoning", sensors=ODOMETRY),
        "smoother": RunConfig("smoother", NO_MAP, (*ODOMETRY, seen)),
        "smoother of 10 s": RunConfig("smoother", {**NO_MAP, "lag": 10.0}, (*ODOMETRY, seen)),
        "monoslam": RunConfig("monoslam", NO_MAP, (*ODOMETRY, seen)),
        "smoother, with tags": RunConfig("smoother", NO_MAP, (*ODOMETRY, "rfid", seen)),
    }


def section(options: Options) -> Report:
    report = Report("slam", options)
    report.say(
        "The start pose is known to 0.1 m and 0.05 rad. Its error remains in all poses of a run, unless tags reduce it. "
        "*Aligned*: the final trajectory is aligned with the reference, which removes the error of the start pose."
    )
    for name, runs, usual, first, folder in (
        ("identified", RUNS, DURATION, FIRST, None),
        ("rendered", RENDERED_RUNS, RENDERED_DURATION, FIRST_RENDERED, options.drives),
    ):
        count, duration = options.count(runs), options.seconds(usual)
        if folder is not None:
            count = min(count, runs)
        jobs = {(name, seed): (Drive(seed, seed, duration), folder) for seed in range(first, first + count)}
        known = report.collect(frame, jobs)
        found = {seed: outcome for (_, seed), outcome in report.collect(mapped, jobs).items()}
        failures(report, found)
        what = (
            f"Each office has {POINTS} points, identified by name. An image shows at most 20 points."
            if folder is None
            else "The images are rendered."
        )
        report.say(
            f"The next table is for drives of {duration:.0f} s in {len(found)} offices, with {RATE:.0f} images per second. {what}"
        )
        report.say(sentence(list(known.values())))
        table(report, found)
    return report


def table(report: Report, found: Attempts) -> None:
    rows = []
    for label in configs(""):
        runs = succeeded(found, label)
        if runs:
            rows.append((label, *accuracy_cells(list(runs.values())), *aligned_cells(found, label)))
    report.table(("estimator", *ACCURACY, "aligned final [m]", "[rad]"), rows)


def aligned_cells(found: Attempts, label: str) -> tuple[str, str]:
    runs: list[Attempt] = [runs[label] for runs in found.values() if label in runs and not runs[label].failure]
    cells = []
    for what, digits in (("position", 4), ("rotation", 5)):
        values = [one.figures.get(f"final.aligned_{what}_rmse") for one in runs]
        known = [value for value in values if value is not None]
        cells.append(f"{pooled_rms(known):.{digits}f}" if known else NOTHING)
    return cells[0], cells[1]


def mapped(drive: Drive, folder: Path | None) -> dict[str, Attempt]:
    """Run all configurations on a drive. ``folder``: the folder of rendered images; None uses named points instead of images."""
    if folder is not None:
        return attempts(log_of(drive, folder), configs("camera"))
    return attempts(simulate(settings(drive, folder), drive.seed), configs("sightings"))


def frame(drive: Drive, folder: Path | None) -> FrameKnown:
    """Return the accuracy with which start and tags determine the frame of a drive."""
    return frame_known(simulate(settings(drive, folder), drive.seed))


def settings(drive: Drive, folder: Path | None) -> SimulationSettings:
    """Return the settings of the simulation of a drive. If ``folder`` is None, the world has named points."""
    if folder is not None:
        return drive.settings()
    world = {"tags": TAGS, "points": POINTS}
    return preset("office", {"world": world, "pixels": {"rate": RATE}, "drive": {"duration": drive.duration}})
