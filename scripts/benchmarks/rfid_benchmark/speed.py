"""Computing times of estimators with RFID reads, and of a calibration."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

from benchmarking.report import Options, Report
from benchmarking.timing import times_table

import factorgraph_loc as fgloc
from factorgraph_loc.calibration.calibrate import calibrate
from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.simulation import simulate
from factorgraph_loc.simulation.settings import preset

SCANS, RATE = 5000, 10.0  # number of scans of all eight antennas, and their rate [Hz]
WORLD = {"world": {"tags": 20}, "rounds_per_second": RATE, "drive": {"duration": SCANS / RATE}}
CALIBRATED = 400.0  # s: duration of the log for the calibration
RUNS = {
    "smoother, lag 10 s": RunConfig("smoother", {"lag": 10.0}),
    "smoother": RunConfig("smoother"),
    "smoother, full history": RunConfig("smoother", {"lag": "all"}),
    "particle filter, 5,000": RunConfig("particle_filter", {"smooth": False}),
    "batch": RunConfig("batch"),
}


def section(options: Options) -> Report:
    report = Report("speed", options)
    report.say(
        f"The log has {SCANS} scans at {RATE:.0f} Hz, of 8 antennas with 20 tags in range. "
        "An update processes a scan and computes the estimate after it."
    )
    times_table(report, partial(simulate, preset("office", WORLD), 0), RUNS)
    folder = options.out / "speed"
    folder.mkdir(parents=True, exist_ok=True)
    for seconds in report.collect(calibration_seconds, {"calibration": (folder / "learnt",)}, workers=1).values():
        report.say(
            f"Calibration from one simulated log of {CALIBRATED:.0f} s (2 scans/s, 40 tags) takes {seconds:.0f} s."
        )
    return report


def calibration_seconds(out: Path) -> float:
    log = simulate(preset("office", {"drive": {"duration": CALIBRATED}}), 0)
    started = time.perf_counter()
    calibrate([log], fgloc.run, grids=out)
    return time.perf_counter() - started
