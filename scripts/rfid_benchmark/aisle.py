"""Real reads: each run localized with what the other run taught."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc.calibration.calibrate import calibrate
from factorgraph_loc.calibration.rssi import fit_rssi
from factorgraph_loc.evaluation.ensembles import first_held
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.ensemble import RunErrors, run_errors, series
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.experiments.trials import HOLD, POSITION
from factorgraph_loc.log import Log
from factorgraph_loc.readers import load
from factorgraph_loc.rfid_settings import PhaseSettings, RfidSettings, SurveySettings
from factorgraph_loc.rig import Rig, write_rig
from factorgraph_loc.trajectory import Trajectory
from rfid_benchmark.report import Options, Report, pooled, spread_cell

RUNS = (13, 16)
SEEDS = 5
LEARNING_SEEDS = (100, 101)  # of the odometry that the models are learnt with: never that of a test
SURVEYED = (-0.217, -0.281)  # m, where the antennas were measured to be, before any learning
SENSORS = {
    "detections": ("odometry", "rfid"),
    "+ RSSI": ("odometry", "rfid", "rssi"),
    "+ phase": ("odometry", "rfid", "phase"),
}
ESTIMATORS = ("particle_filter", "smoother")
CONFIGS = {("dead_reckoning", ""): RunConfig("dead_reckoning")} | {
    (estimator, name): RunConfig(estimator, sensors=sensors)
    for name, sensors in SENSORS.items()
    for estimator in ESTIMATORS
}
FROZEN = "detections, frozen rig"
START_SPAN = 120.0  # s of a run that tell how an unknown start went


@dataclass(frozen=True)
class Learning:
    run: int
    data_root: Path | None
    out: Path


@dataclass(frozen=True)
class Test:
    run: int
    seed: int
    rig: Rig
    config: RunConfig
    data_root: Path | None


def section(options: Options) -> Report:
    report = Report("aisle", options)
    learning = [Learning(run, options.data_root, options.out / "aisle") for run in RUNS]
    rigs = report.collect(learnt_on, learning, [f"learning on run {run}" for run in RUNS])
    frozen = aisle(RUNS[0], 0, options.data_root).rig
    seeds = range(min(SEEDS, options.count(SEEDS)))
    jobs: dict[tuple[Any, ...], Test] = {}
    starts: dict[tuple[Any, ...], Test] = {}
    for i, run_number in enumerate(RUNS):
        if 1 - i not in rigs:
            continue
        for seed in seeds:
            for key, config in CONFIGS.items():
                jobs[(*key, run_number, seed)] = Test(run_number, seed, rigs[1 - i], config, options.data_root)
            for estimator in ESTIMATORS:
                config = CONFIGS[estimator, "detections"]
                jobs[estimator, FROZEN, run_number, seed] = Test(run_number, seed, frozen, config, options.data_root)
                unknown = replace(config, prior="unknown", seed=seed)
                starts[estimator, run_number, seed] = Test(run_number, seed, rigs[1 - i], unknown, options.data_root)
    keys = list(jobs)
    found = report.collect(errors_of, list(jobs.values()), [" ".join(map(str, key)) for key in keys])
    accuracy(report, {keys[i]: outcome for i, outcome in found.items()})
    keys = list(starts)
    found = report.collect(seconds_to_right, list(starts.values()), [f"unknown start, {key}" for key in keys])
    unknown_starts(report, {keys[i]: outcome for i, outcome in found.items()})
    return report


def accuracy(report: Report, found: dict[tuple[Any, ...], RunErrors]) -> None:
    report.say(
        f"Each run with what the other one taught, odometry seeds 0 to {SEEDS - 1}; "
        f"*{FROZEN}*: the shipped rig, which has learnt from both. "
        "RMSE / median / p95 [m] / heading RMSE [degrees] / ANEES"
    )
    rows = []
    for key in dict.fromkeys(key[:2] for key in found):
        for label, runs in (*((f"run {n}", (n,)) for n in RUNS), ("**both**", RUNS)):
            members = [e for k, e in found.items() if k[:2] == key and k[2] in runs]
            if members:
                cells = [spread_cell([getattr(e, kind) for e in members]) for kind in ("causal", "final")]
                rows.append((label, *key, *cells))
    report.table(("run", "estimator", "sensors", "causal", "final"), rows)
    single = [(*key, *pooled([e.causal]), *pooled([e.final])) for key, e in found.items()]
    heads = ("estimator", "sensors", "run", "odometry_seed", "causal_m", "causal_deg", "final_m", "final_deg")
    report.figures("runs", heads, single)


def unknown_starts(report: Report, found: dict[tuple[Any, ...], float]) -> None:
    report.say(
        f"Unknown start, detections: seconds until the estimate is below {POSITION} m for {HOLD:.0f} s, for each seed"
    )
    rows = []
    for estimator in ESTIMATORS:
        for number in RUNS:
            seconds = [s for k, s in found.items() if k[:2] == (estimator, number)]
            if seconds:
                cells = ", ".join("never" if np.isnan(s) else f"{s:.0f}" for s in seconds)
                rows.append((f"run {number}", estimator, cells, f"{max(seconds):.0f}"))
    report.table(("run", "estimator", "by seed [s]", "longest [s]"), rows)


def aisle(number: int, seed: int, data_root: Path | None) -> Log:
    """The recording with one odometry seed."""
    return load(f"rfid-aisle-run{number}", data_root=data_root, options={"odometry_seed": seed})[0]


def learnt_on(job: Learning) -> Rig:
    """The rig that one recording teaches, from antennas as surveyed. The odometry is that of the shipped rig, which is exact."""
    logs = [aisle(job.run, seed, job.data_root) for seed in LEARNING_SEEDS]
    shipped = logs[0].rig
    assert shipped.rfid is not None
    start = shipped.model_copy(update={"rfid": surveyed(shipped.rfid), "survey": SurveySettings()})
    job.out.mkdir(parents=True, exist_ok=True)
    name = f"learnt-on-run{job.run}"
    found = calibrate(logs, lambda log: score(run(log, RunConfig("smoother")), log), start, grids=job.out / name).rig
    assert found.rfid is not None
    rssi = fit_rssi(logs[:1], found.rfid, found.survey).settings
    rfid = found.rfid.model_copy(update={"rssi": rssi, "phase": shipped.rfid.phase or PhaseSettings()})
    rig = shipped.model_copy(update={"rfid": rfid, "survey": found.survey})
    write_rig(rig, job.out / f"{name}.rig.toml")
    return rig


def surveyed(rfid: RfidSettings) -> RfidSettings:
    """The reader before anything was learnt."""
    x, y = SURVEYED
    antennas = {
        name: a.model_copy(update={"x": x, "y": y, "yaw": -np.pi / 2, "model": "default"})
        for name, a in rfid.all_antennas().items()
    }
    return RfidSettings(
        antennas=antennas,
        false_read=rfid.false_read,
        miss=rfid.miss,
        round_gap=rfid.round_gap,
        time_offset=rfid.time_offset,
    )


def errors_of(job: Test) -> RunErrors:
    log = replace(aisle(job.run, job.seed, job.data_root), rig=job.rig)
    return run_errors(run(log, job.config), log)


def seconds_to_right(job: Test) -> float:
    """From the first scan until the estimate stays within half a metre; whatever its status."""
    log = replace(aisle(job.run, job.seed, job.data_root), rig=job.rig)
    result = run(log, job.config)
    errors = series(Trajectory(result.t, result.poses, result.covariances), log)
    first = float(log.streams["rfid"].t[0])
    known = np.isfinite(errors.position) | (errors.t < START_SPAN)
    return first_held(errors.t[known], errors.position[known] < POSITION, HOLD) - first
