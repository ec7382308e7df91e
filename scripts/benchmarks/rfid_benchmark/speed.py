"""Run times; one process at a time."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmarking.report import Options, Report

import factorgraph_loc as fgloc
from factorgraph_loc.calibration.calibrate import calibrate
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.simulation import simulate
from factorgraph_loc.simulation.settings import preset

SCANS, RATE = 5000, 10.0  # with all eight antennas; Hz
WORLD = {"world": {"tags": 20}, "rounds_per_second": RATE, "drive": {"duration": SCANS / RATE}}
CALIBRATED = 400.0  # s of a log
RUNS = {
    "smoother, lag 10 s": RunConfig("smoother", {"lag": 10.0}),
    "smoother": RunConfig("smoother"),
    "smoother, full history": RunConfig("smoother", {"lag": "all"}),
    "particle filter, 5,000": RunConfig("particle_filter", {"smooth": False}),
    "batch": RunConfig("batch"),
}


@dataclass(frozen=True)
class Job:
    """A run, or a calibration if there is no ``config``; learnt grids are written to ``out``."""

    config: RunConfig | None
    out: Path = Path()


@dataclass(frozen=True)
class Times:
    """``update_ms`` (M,) of each scan; total times ``causal``, ``final`` [s]; ``memory`` [MB]."""

    update_ms: np.ndarray
    causal: float
    final: float
    memory: float


def section(options: Options) -> Report:
    report = Report("speed", options)
    folder = options.out / "speed"
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [Job(config) for config in RUNS.values()] + [Job(None, folder / "learnt")]
    labels = [*RUNS, "calibration"]
    found = report.collect(timed, jobs, labels, workers=1)
    report.say(
        f"{SCANS} scans at {RATE:.0f} Hz, each of 8 antennas that listen for 20 tags. "
        "A step is a scan with the estimate after it."
    )
    rows = []
    for i, label in enumerate(RUNS):
        if i in found:
            times: Times = found[i]
            ms, quarter = times.update_ms, len(times.update_ms) // 4
            cells = ("–", "–")
            if label != "batch":
                step = f"{np.median(ms):.2f} / {np.percentile(ms, 99):.1f} / {ms.max():.0f}"
                cells = (step, f"{np.median(ms[:quarter]):.2f} / {np.median(ms[-quarter:]):.2f}")
            rows.append((label, *cells, f"{times.causal:.1f}", f"{times.final:.1f}", f"{times.memory:.0f}"))
    heads = ("estimator", "step median / p99 / max [ms]", "first / last quarter median [ms]", "causal, all [s]")
    report.table((*heads, "final [s]", "peak memory [MB]"), rows)
    if len(RUNS) in found:
        report.say(
            f"Calibration of one simulated log of {CALIBRATED:.0f} s (2 scans/s, 40 tags): {found[len(RUNS)]:.0f} s."
        )
    return report


def timed(job: Job) -> Times | float:
    """The times of a run, or the seconds of a calibration."""
    if job.config is None:
        return calibration_seconds(job.out)
    log = simulate(preset("office", WORLD), 0)
    # exclude compilation
    run(simulate(preset("office", {**WORLD, "drive": {"duration": 20.0}}), 1), job.config)
    timings = run(log, job.config).timings
    return Times(timings.update_ms, timings.causal_seconds, timings.final_seconds, timings.peak_memory_mb)


def calibration_seconds(out: Path) -> float:
    log = simulate(preset("office", {"drive": {"duration": CALIBRATED}}), 0)
    started = time.perf_counter()
    calibrate([log], fgloc.run, grids=out)
    return time.perf_counter() - started
