"""Computing times with a camera, measured in one process at a time. Only the detection of features uses several threads."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from benchmarking.report import NOTHING, Options, Report

from camera_benchmark.drives import COUNT, FEATURE, RATE, Drive, log_of, map_of, with_map
from factorgraph_loc.experiments.preparation import use_of
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion import registry
from factorgraph_loc.sensors.camera.use import prepare
from factorgraph_loc.simulation import film, preset, simulate, with_images
from factorgraph_loc.vision.association import Associator
from factorgraph_loc.vision.feature_cache import VARIABLE
from factorgraph_loc.vision.tracks import FeatureTracker

POINTS = 3000  # so many that nearly always at least 20 are in view
SEED = 0
WARM_UP = 20.0  # s of another drive, which is run before, so that compilation is not measured
DURATION = 300.0  # s
FIRST = 6000
IMAGES, RENDERED = 600, 200
KNOWN: Mapping[str, Any] = {"rounds_per_second": 10.0, "pixels": {"rate": 10.0}}
KEYFRAMES: Mapping[str, Any] = {"pixels": {"rate": 2.0}}  # one image per keyframe
NO_MAP: Mapping[str, Any] = {"landmarks": "unknown"}
ALL, SEEN = ("odometry", "rfid", "sightings"), ("odometry", "sightings")


@dataclass(frozen=True)
class Steps:
    """A run whose steps are timed. ``what``: a description for the table. ``changes``: settings of the simulation."""

    what: str
    changes: Mapping[str, Any]
    config: RunConfig


STEPS = (
    Steps("20 known points and all antennas, 10 Hz", KNOWN, RunConfig("smoother", {"lag": 10.0}, ALL)),
    Steps("the same, full history", KNOWN, RunConfig("smoother", {"lag": "all"}, ALL)),
    Steps("the same", KNOWN, RunConfig("ekf", {}, SEEN)),
    Steps("the same", KNOWN, RunConfig("particle_filter", {"smooth": False}, ALL)),
    Steps("20 known points, 10 Hz", KNOWN, RunConfig("monoslam", {"smooth": False}, SEEN)),
    Steps("20 unknown points, a keyframe each", KEYFRAMES, RunConfig("smoother", {**NO_MAP, "lag": 10.0}, SEEN)),
    Steps("the same, full history", KEYFRAMES, RunConfig("smoother", NO_MAP, SEEN)),
    Steps("20 unknown points, 100 in the state, 5 Hz", {}, RunConfig("monoslam", {**NO_MAP, "max_points": 100}, SEEN)),
)


@dataclass(frozen=True)
class Links:
    """The computing times of a drive with ``images`` and a map of ``points`` [s]: to detect features, to track them, to match
    them with the map, and to run the smoother."""

    images: int
    feature: str
    points: int
    find: float
    follow: float
    associate: float
    smooth: float


def section(options: Options) -> Report:
    report = Report("speed", options)
    chain(report, options)
    estimators(report, options.seconds(DURATION))
    return report


def chain(report: Report, options: Options) -> None:
    """Report the times of all steps from images to poses, and the speed of the renderer."""
    for links in report.collect(chained, {"chain": (options.drives,)}, workers=1).values():
        report.say(
            f"The log has {links.images} images of 640 x 480 px with at most {COUNT} features (`{links.feature}`) each, "
            "and a map of "
            f"{links.points} points. {os.cpu_count()} threads detect features, the other steps use one thread. *Associate*: "
            "matching of features with the map. *Smooth*: time of the smoother without *associate*."
        )
        whole = links.find + links.follow + links.associate + links.smooth
        parts = {name: getattr(links, name) for name in ("find", "follow", "associate", "smooth")}
        cells = (f"{1e3 * s / links.images:.1f} ({100 * s / whole:.0f} %)" for s in parts.values())
        heads = (*(f"{name} [ms]" for name in ("detect", "track", "associate", "smooth")), "images/s")
        report.table(heads, [(*cells, f"{links.images / whole:.1f}")])
    for rate in report.collect(rendered, {"renderer": ()}, workers=1).values():
        report.say(f"The renderer makes {rate:.1f} images/s on one core.")


def estimators(report: Report, duration: float) -> None:
    jobs = {(i, steps.what): (steps, duration) for i, steps in enumerate(STEPS)}
    report.say(
        f"The next table has times of steps in {duration:.0f} s of `office` with identified points. A step processes an image with "
        "about 20 points (and a round of all eight antennas), and computes the estimate. *Second half*: steps in the "
        "second half of "
        "the run. *Learnt*: number of points that are estimated."
    )
    rows = []
    for (i, _), (ms, learnt) in report.collect(timed, jobs, workers=1).items():
        steps, half = STEPS[i], ms[len(ms) // 2 :]
        median, p99, worst = np.median(ms), np.percentile(ms, 99), ms.max()
        step = f"{median:.2f} / {p99:.2f} / {worst:.1f}"
        later = f"{np.median(half):.2f} / {np.percentile(half, 99):.2f}"
        rows.append((steps.what, steps.config.estimator, step, later, learnt))
    heads = ("what", "estimator", "median / p99 / max [ms]", "second half", "learnt")
    report.table(heads, rows)


def chained(kept: Path) -> Links:
    """Measure the times of all steps from image files to poses, without cached features."""
    drive = Drive(FIRST, FIRST, IMAGES / RATE)
    points = map_of(drive, kept)
    config = RunConfig("smoother", {"lag": 10.0}, ("odometry", "rfid", "camera"))
    warm = log_of(replace(drive, seed=FIRST + 1, duration=WARM_UP), kept)
    run(with_map(warm, points), config)
    with tempfile.TemporaryDirectory() as name:
        os.environ[VARIABLE] = name
        folder = Path(name) / "images"
        folder.mkdir()
        settings = drive.settings()
        log = with_map(with_images(simulate(settings, drive.seed), settings, drive.seed, folder), points)
        with (
            spent(FeatureTracker, "follow") as follow,
            spent(Associator, "guided") as guided,
            spent(Associator, "relocalized") as relocalized,
        ):
            chosen = registry.settings_of(config.estimator, config.settings)
            prepared = prepare(use_of(log, config.sensors or (), config.estimator, chosen), lambda _: None)
            started = perf_counter()
            run(prepared.log, config)
            smooth = perf_counter() - started
    find, associate = prepared.seconds - sum(follow), sum(guided) + sum(relocalized)
    return Links(prepared.images, FEATURE, len(points), find, sum(follow), associate, smooth - associate)


def rendered() -> float:
    """Return the number of rendered images per second. The creation of the scene and compilation are not measured."""
    drive = Drive(FIRST, FIRST, RENDERED / RATE)
    images = iter(film(drive.settings(), drive.seed))
    next(images)
    started = perf_counter()
    count = sum(1 for _ in images)
    return count / (perf_counter() - started)


@contextmanager
def spent(owner: object, name: str) -> Iterator[list[float]]:
    """Record the duration [s] of each call of the function ``name`` of a module or class. Yields the list of durations."""
    function, seconds = getattr(owner, name), []

    def timed_call(*arguments: Any, **named: Any) -> Any:
        started = perf_counter()
        try:
            return function(*arguments, **named)
        finally:
            seconds.append(perf_counter() - started)

    setattr(owner, name, timed_call)
    try:
        yield seconds
    finally:
        setattr(owner, name, function)


def timed(steps: Steps, duration: float) -> tuple[np.ndarray, str]:
    """Run and time the steps. Returns the time (M,) [ms] of each step, and the number of estimated points as a text."""
    run(simulate(preset("office", changed(steps, WARM_UP)), SEED + 1), steps.config)
    log = simulate(preset("office", changed(steps, duration)), SEED)
    result = run(log, steps.config)
    learnt = str(len(result.learnt.landmarks)) if steps.config.estimator == "monoslam" else NOTHING
    return result.timings.update_ms, learnt


def changed(steps: Steps, duration: float) -> dict[str, Any]:
    return {"world": {"tags": 20, "points": POINTS}, "drive": {"duration": duration}, **steps.changes}
