"""The quick benchmark: the computing times of estimators, divided by the times of reference workloads in the same run.

A reference workload is plain code that does not depend on this project. Its time shows the speed of the machine at that moment.
Estimator and reference take turns, and the smallest time of each is used. All times are processor times in one process, on
simulated logs.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
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
from landmarks_benchmark.ours import CONFIGS, PARTICLES, Times, Work, least, timed_loop, timed_run
from landmarks_benchmark.problems import landmark_log, problem_of
from landmarks_benchmark.programs import gtsam_loops, numpy_filters

SECONDS = 120.0  # duration of the drive among landmarks
OTHER_SECONDS = 30.0  # duration of the drives among tags and among points
ROUNDS = 3
BESIDE = {
    "EKF": "numpy EKF",
    "EKF, 5 constants": "numpy EKF",
    "smoother, lag 10 s, 5 constants": "GTSAM, fixed lag",
    "smoother, 5 constants": "GTSAM, iSAM2",
    "smoother, full history, 5 constants": "GTSAM, iSAM2",
    "particle filter, 5,000": "numpy particles",
    "batch": "GTSAM, batch",
}
WORSE = 1.25  # an estimator has become slower if its ratio exceeds the stored ratio by this factor


def losses(found: Mapping[str, float], stored: Mapping[str, float]) -> list[str]:
    """Return a line for each ratio in ``found`` that exceeds the ``stored`` one by more than the factor :data:`WORSE`."""
    return [
        f"{name}: {found[name]:.2f}, was {before:.2f}"
        for name, before in stored.items()
        if name in found and found[name] > WORSE * before
    ]


def read_ratios(path: Path) -> dict[str, float]:
    """Read the ratios that an earlier run stored. Raises InputError if the file contains none."""
    try:
        ratios = json.loads(read_text(path))["ratios"]
        return {str(name): float(value) for name, value in ratios.items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(
            f"{path}: contains no ratios, expected a file that scripts/bench --quick has written"
        ) from error


def quick(out: Path, against: Path | None) -> int:
    """Measure all ratios, print them as a table, and store them in ``out``. Returns the exit code: 1 if a ratio is worse than
    that in the file ``against``, otherwise 0."""
    stored = read_ratios(against) if against is not None else {}
    out.parent.mkdir(parents=True, exist_ok=True)
    pairs, beside = workloads()
    best = least(pairs, ROUNDS)
    found = {name: (ours.seconds, reference.seconds) for name, (ours, reference) in best.items()}
    ratios = {name: ours / reference for name, (ours, reference) in found.items()}
    print("| ours | s | reference | s | ours / reference | before |\n|---|---|---|---|---|---|")
    for name, (ours, reference) in found.items():
        before = f"{stored[name]:.2f}" if name in stored else "–"
        print(f"| {name} | {ours:.3f} | {beside[name]} | {reference:.3f} | {ratios[name]:.2f} | {before} |")
    write_text(out, json.dumps({"ratios": ratios, "seconds": found}, indent=1) + "\n")
    print(f"\nstored: {out}")
    worse = losses(ratios, stored)
    for line in worse:
        print(f"slower than before: {line}")
    return int(bool(worse))


def workloads() -> tuple[dict[str, tuple[Work, Work]], dict[str, str]]:
    """Return all pairs of a workload of this project and a reference workload, and the names of the references, both by name of the
    workload."""
    log, tags, points, picture = landmark_log(SECONDS), _tags(), _points(), _picture()
    problem = problem_of(log)
    references = {
        "numpy EKF": timed_loop(numpy_filters.ekf, problem),
        "numpy particles": timed_loop(numpy_filters.particles, problem),
        "GTSAM, fixed lag": timed_loop(gtsam_loops.lag, problem),
        "GTSAM, iSAM2": timed_loop(gtsam_loops.full, problem),
        "GTSAM, batch": timed_loop(gtsam_loops.batch, problem),
        "SIFT": _found("sift", picture),
        "import numpy": lambda: _started("import numpy"),
    }
    window = RunConfig("smoother", {"lag": 10.0})
    particles = RunConfig("particle_filter", {"particles": PARTICLES})
    ours: dict[str, tuple[Work, str]] = {
        **{name: (timed_run(log, CONFIGS[name]), what) for name, what in BESIDE.items()},
        "Localizer, EKF": (lambda: _pushed(log), "numpy EKF"),
        "tags, smoother, lag 10 s": (timed_run(tags, window), "GTSAM, fixed lag"),
        "tags, particle filter, 5,000": (timed_run(tags, particles), "numpy particles"),
        "points, smoother, lag 10 s": (timed_run(points, window), "GTSAM, fixed lag"),
        "features": (_found("colour", picture), "SIFT"),
        "start of fgloc": (lambda: _started("from factorgraph_loc.cli import main"), "import numpy"),
    }
    pairs = {name: (work, references[what]) for name, (work, what) in ours.items()}
    return pairs, {name: what for name, (_, what) in ours.items()}


def _pushed(log: Log) -> Times:
    """Push the measurements of a log to a localizer, and ask for an estimate after each measurement of landmarks. Returns the
    time."""
    assert log.start is not None
    localizer = Localizer(log.rig, log.world, "ekf", settings={"self_calibration": False})
    localizer.initialize(log.start.pose, np.diag(np.square(log.start.sigmas)), log.start.t)
    measurements = [m for m in log.measurements(("odometry", "bearing_range")) if m.t >= log.start.t]
    started = time.process_time()
    for m in measurements:
        localizer.push(m)
        if not m.is_motion:
            localizer.estimate()
    return Times(time.process_time() - started)


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

    def work() -> Times:
        started = time.process_time()
        extract.detectAndCompute(picture, None)
        return Times(time.process_time() - started)

    return work


def _started(code: str) -> Times:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", code], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return Times(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
