"""Faults of cameras and images, one at a time: their effect on the errors, and the recovery."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarking.report import Options, Report, pooled

from camera_benchmark.drives import Drive, log_of, map_of, with_map
from camera_benchmark.faulty import FAULTS, Given
from camera_benchmark.office import BOTH, CAMERA
from camera_benchmark.report import Attempt, attempt
from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.model.log import Log

SEEDS = 3
FIRST = 9000
DURATION = 150.0  # s
AFTERWARDS = 30.0  # s at the end, after the end of temporary faults
BACK = (
    0.10  # m: an estimate with a smaller error has recovered, and so has one with less than twice that without a fault
)
RIGHT = "none"
NO_MAP = "smoother, camera, no map"
CONFIGS = {
    "ekf, camera": RunConfig("ekf", sensors=CAMERA),
    "monoslam, camera": RunConfig("monoslam", sensors=CAMERA),
    "smoother, camera": RunConfig("smoother", sensors=CAMERA),
    "smoother, rfid, camera": RunConfig("smoother", sensors=BOTH),
    NO_MAP: RunConfig("smoother", sensors=CAMERA),
}


def section(options: Options) -> Report:
    report = Report("faults", options)
    drives = [Drive(FIRST + i, FIRST + i, options.seconds(DURATION)) for i in range(options.count(SEEDS))]
    # render and map the images of each drive first, because several processes need them later
    ready = report.collect(prepared, {("drive", drive.seed): (drive, options.drives) for drive in drives})
    jobs = {
        (fault, drive.seed): (fault, drive, options.drives)
        for fault in FAULTS
        for drive in drives
        if ("drive", drive.seed) in ready
    }
    outcomes = report.collect(faulty, jobs)
    report.say(
        f"Number of rendered offices: {len(ready)}. Each drive has {options.seconds(DURATION):.0f} s, and the map is from another "
        "drive. The cells are "
        f"position RMSE [m]: causal / final / causal in the last {AFTERWARDS:.0f} s of the worst run."
    )
    runs = {fault: [found for (name, _), found in outcomes.items() if name == fault] for fault in FAULTS}
    runs = {fault: found for fault, found in runs.items() if found}
    rows = [
        (
            fault,
            *(cell([one[label] for one in found], [one[label] for one in runs.get(RIGHT, [])]) for label in CONFIGS),
        )
        for fault, found in runs.items()
    ]
    report.table(("fault", *CONFIGS), rows)
    return report


def prepared(drive: Drive, folder: Path) -> int:
    log_of(drive, folder)
    return len(map_of(drive, folder))


def faulty(fault: str, drive: Drive, folder: Path) -> dict[str, Attempt]:
    """Run all configurations on a drive with a fault. Returns the outcomes by label."""
    log = with_map(log_of(drive, folder), map_of(drive, folder))
    files = folder / "faults" / f"{re.sub(r'[^a-z0-9]+', '-', fault.lower())}-{drive.seed}"
    outcomes: dict[str, Attempt] = {}
    for label, config in CONFIGS.items():
        of = without_map(log) if label == NO_MAP else log
        given = Given(of, np.random.default_rng(drive.seed), files)
        outcomes[label] = attempt(FAULTS[fault](given), config)
    return outcomes


def without_map(log: Log) -> Log:
    """Return the log without the points of its map."""
    return replace(log, world=log.world.model_copy(update={"points": None}))


def cell(runs: Sequence[Attempt], right: Sequence[Attempt]) -> str:
    errors = [one.errors for one in runs if one.errors is not None]
    if len(errors) < len(runs):
        return f"{len(runs) - len(errors)} of {len(runs)} refused"
    causal, final = (pooled([getattr(one, kind) for one in errors])[0] for kind in ("causal", "final"))
    last, usual = at_end(runs), at_end(right)
    return f"{causal:.3f} / {final:.3f} / {last:.3f}" + ("" if last <= max(BACK, 2.0 * usual) else ", lost")


def at_end(runs: Sequence[Attempt]) -> float:
    """Return the causal RMSE [m] of the last part of the runs, that of the worst run."""
    causal = [one.errors.causal for one in runs if one.errors is not None]
    return max((one.where(one.t > one.t[-1] - AFTERWARDS).position_rmse() for one in causal), default=0.0)
