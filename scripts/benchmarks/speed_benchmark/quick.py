"""The quick benchmark: how long our estimators take, as ratios to fixed reference workloads of the same run.

A reference is plain code that this project's changes do not touch, so that its time stands for the speed of the machine at that
moment. Both take turns, and the least of the times of each counts. All is processor time, in one process, on simulated logs.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from factorgraph_loc import Localizer
from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.files.models import read_text, write_text
from factorgraph_loc.model.log import Log
from factorgraph_loc.simulation import preset, simulate
from factorgraph_loc.vision.features import extractor
from speed_benchmark.ours import CONFIGS, PARTICLES, seconds_of, timed
from speed_benchmark.problems import landmark_log, problem_of
from speed_benchmark.programs import gtsam_loops, numpy_filters
from speed_benchmark.programs.plain import Loop, Problem

SECONDS = 120.0  # of the drive among landmarks
OTHER_SECONDS = 30.0  # of those among tags and points
ROUNDS = 3
WORSE = 1.25  # times the stored ratio
"""A ratio that is farther above the stored one is a loss of speed."""
Work = Callable[[], float]


@dataclass(frozen=True)
class Pair:
    """Two workloads that return their processor time [s]; ``beside``: what the reference is."""

    ours: Work
    reference: Work
    beside: str


def measure(pairs: Mapping[str, Pair], rounds: int = ROUNDS) -> dict[str, tuple[float, float]]:
    """The least time [s] of ours and of the reference, of each pair. The first round compiles, and does not count."""
    best = dict.fromkeys(pairs, (np.inf, np.inf))
    for i in range(rounds + 1):
        for name, pair in pairs.items():
            both = pair.ours(), pair.reference()
            if i:
                best[name] = min(best[name][0], both[0]), min(best[name][1], both[1])
    return best


def losses(found: Mapping[str, float], stored: Mapping[str, float]) -> list[str]:
    """A line for each ratio that is worse than the stored one by more than :data:`WORSE`."""
    return [
        f"{name}: {found[name]:.2f}, was {before:.2f}"
        for name, before in stored.items()
        if name in found and found[name] > WORSE * before
    ]


def read_ratios(path: Path) -> dict[str, float]:
    """The ratios that a run stored. Raises InputError if the file holds none."""
    try:
        ratios = json.loads(read_text(path))["ratios"]
        return {str(name): float(value) for name, value in ratios.items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path}: expected a table that scripts/bench --quick has stored") from error


def quick(out: Path, against: Path | None) -> int:
    """Measure, print the table, and store it; the exit code is 1 if a ratio is worse than the one of ``against``."""
    stored = read_ratios(against) if against is not None else {}
    out.parent.mkdir(parents=True, exist_ok=True)
    pairs = workloads()
    found = measure(pairs)
    ratios = {name: ours / reference for name, (ours, reference) in found.items()}
    print("| ours | s | reference | s | ours / reference | before |\n|---|---|---|---|---|---|")
    for name, (ours, reference) in found.items():
        before = f"{stored[name]:.2f}" if name in stored else "–"
        print(f"| {name} | {ours:.3f} | {pairs[name].beside} | {reference:.3f} | {ratios[name]:.2f} | {before} |")
    write_text(out, json.dumps({"ratios": ratios, "seconds": found}, indent=1) + "\n")
    print(f"\nstored: {out}")
    worse = losses(ratios, stored)
    for line in worse:
        print(f"slower than before: {line}")
    return int(bool(worse))


def workloads() -> dict[str, Pair]:
    """All pairs, by name."""
    log = landmark_log(SECONDS)
    problem = problem_of(log)
    loops = {
        "numpy EKF": _loop(numpy_filters.ekf, problem),
        "numpy particles": _loop(numpy_filters.particles, problem),
        "GTSAM, fixed lag": _loop(gtsam_loops.lag, problem),
        "GTSAM, iSAM2": _loop(gtsam_loops.full, problem),
        "GTSAM, batch": _loop(gtsam_loops.batch, problem),
    }
    references = (
        "numpy EKF",
        "numpy EKF",
        "GTSAM, fixed lag",
        "GTSAM, iSAM2",
        "GTSAM, iSAM2",
        "numpy particles",
        "GTSAM, batch",
    )
    beside = dict(zip(CONFIGS, references, strict=True))
    pairs = {name: Pair(_run(log, CONFIGS[name]), loops[what], what) for name, what in beside.items()}
    pairs["Localizer, EKF"] = Pair(lambda: _pushed(log), loops["numpy EKF"], "numpy EKF")
    tags, points = _tags(), _points()
    window = RunConfig("smoother", {"lag": 10.0})
    particles = RunConfig("particle_filter", {"particles": PARTICLES})
    for name, other, config, what in (
        ("tags, smoother, lag 10 s", tags, window, "GTSAM, fixed lag"),
        ("tags, particle filter, 5,000", tags, particles, "numpy particles"),
        ("points, smoother, lag 10 s", points, window, "GTSAM, fixed lag"),
    ):
        pairs[name] = Pair(_run(other, config), loops[what], what)
    picture = _picture()
    pairs["features"] = Pair(_found("colour", picture), _found("sift", picture), "SIFT")
    pairs["start of fgloc"] = Pair(
        lambda: _started("from factorgraph_loc.cli import main"), lambda: _started("import numpy"), "import numpy"
    )
    return pairs


def _loop(loop: Loop, problem: Problem) -> Work:
    def work() -> float:
        started = time.process_time()
        loop(problem)
        return time.process_time() - started

    return work


def _run(log: Log, config: RunConfig) -> Work:
    return lambda: seconds_of(timed(log, config))


def _pushed(log: Log) -> float:
    """The measurements of a log, one after the other, with an estimate after each stamp with landmarks."""
    assert log.start is not None
    localizer = Localizer(log.rig, log.world, "ekf", settings={"self_calibration": False})
    localizer.initialize(log.start.pose, np.diag(np.square(log.start.sigmas)), log.start.t)
    measurements = [m for m in log.measurements(("odometry", "bearing_range")) if m.t >= log.start.t]
    started = time.process_time()
    for m in measurements:
        localizer.push(m)
        if not m.is_motion:
            localizer.estimate()
    return time.process_time() - started


def _tags() -> Log:
    return simulate(preset("office", {"drive": {"duration": OTHER_SECONDS}, "world": {"tags": 20}}), 0)


def _points() -> Log:
    world = {"tags": 1, "points": 400}
    log = simulate(preset("office", {"drive": {"duration": OTHER_SECONDS}, "world": world, "pixels": {"rate": 5.0}}), 0)
    streams = {name: log.streams[name] for name in ("odometry", "sightings")}
    return replace(log, streams=streams, rig=log.rig.model_copy(update={"sensors": tuple(streams)}))


def _picture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    return cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC)


def _found(feature: str, picture: np.ndarray) -> Work:
    extract = extractor(feature)

    def work() -> float:
        started = time.process_time()
        extract.detectAndCompute(picture, None)
        return time.process_time() - started

    return work


def _started(code: str) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", code], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
