"""Loops of another program on two drives of hundreds of metres, of which most are false: the final trajectory with all of them
beside that with right ones, as the reference tells them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from benchmarking.report import Options, Report

from factorgraph_loc.evaluation.pairing import align, pairs
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.loops.measurement import LoopStream
from factorgraph_loc.sensors.odometry.settings import GrowthSettings, OdometryNoise
from factors import se2
from recordings_benchmark.listed import RECORDINGS
from recordings_benchmark.prepare import prepare

NAMES = ("corridor", "lecture-hall")
# the data set states 0.05 m/s and 0.01 rad/s for each of ten rows a second
POSITION = GrowthSettings(per_time=0.05 * np.sqrt(0.1))
NOISE = OdometryNoise(along=POSITION, lateral=POSITION, heading=GrowthSettings(per_time=0.01 * np.sqrt(0.1)))
SCORES = (0.43, 0.3)  # the first is that of the authors' configuration
NEAR, GAP = 1.0, 5.0  # m between the two places of a right loop; s between poses of the reference
HEADS = ("log", "score of at least", "loops", "right", "odometry alone", "right ones", "all", "ratio")


@dataclass(frozen=True)
class Job:
    log: Log
    estimator: str


def section(options: Options) -> Report:
    assert options.data_root is not None
    report = Report("loops", options)
    report.say(
        "Aligned position RMSE [m] of the smoother's final trajectories. A loop is right if its places are less than "
        f"{NEAR:g} m apart in the reference, which no estimator sees."
    )
    jobs: list[Job] = []
    kept: list[tuple[str, float, int, int]] = []
    for name in NAMES:
        log, near = log_of(name, options.data_root, options.out / "logs")
        jobs.append(Job(log, "dead_reckoning"))
        for least in SCORES:
            loops = log.streams["loops"]
            assert isinstance(loops, LoopStream)
            scored = loops.score >= least
            kept.append((name, least, int(scored.sum()), int((scored & near).sum())))
            jobs += [Job(chosen(log, keep), "smoother") for keep in (scored & near, scored)]
    found = report.collect(aligned_error, jobs, [f"{job.log.name} {job.estimator}" for job in jobs])
    rows = []
    for i, (name, least, count, right) in enumerate(kept):
        first = i // len(SCORES) * (1 + 2 * len(SCORES))
        at = first + 1 + 2 * (i % len(SCORES))
        alone, best, every = (found.get(job, np.nan) for job in (first, at, at + 1))
        told = [f"{error:.2f}" for error in (alone, best, every, every / best)]
        rows.append((name, f"{least:g}", str(count), f"{right / count:.0%}", *told))
    report.table(HEADS, rows)
    return report


def log_of(name: str, folder: Path, out: Path) -> tuple[Log, np.ndarray]:
    """The whole drive with its loops, and which of these (N,) are right."""
    recording = next(one for one in RECORDINGS if one.name == name)
    whole = replace(recording, name=f"{name}-whole", seconds=None)
    log = prepare(whole, folder, out)
    lines = (folder / recording.files[0].name).read_text(encoding="utf-8").splitlines()
    rows = np.array([[float(cell) for cell in line.split()[1:]] for line in lines if line.startswith("loop ")])
    later, earlier, score = rows.T
    nothing = np.full(len(rows), np.nan)
    odometry = log.rig.odometry.model_copy(update={"noise": NOISE})
    log = replace(
        log,
        rig=log.rig.model_copy(update={"sensors": ("odometry", "loops"), "odometry": odometry}),
        streams={
            "odometry": log.streams["odometry"],
            "loops": LoopStream(later, later - earlier, nothing, nothing, nothing, score),
        },
    )
    assert log.reference is not None
    here, there = (log.reference.at(t, max_gap=GAP)[:, :2] for t in (later, earlier))
    return log, np.linalg.norm(here - there, axis=1) < NEAR


def chosen(log: Log, keep: np.ndarray) -> Log:
    """The log with some of its loops."""
    loops = log.streams["loops"]
    assert isinstance(loops, LoopStream)
    columns = {name: getattr(loops, name)[keep] for name in ("t", "age", "x", "y", "heading", "score")}
    return replace(log, streams=dict(log.streams) | {"loops": LoopStream(**columns)})


def aligned_error(job: Job) -> float:
    """Position RMSE [m] of the final trajectory after alignment with the reference."""
    assert job.log.reference is not None
    found = run(job.log, RunConfig(job.estimator, prior="0,0,0")).final
    assert found is not None
    pair = pairs(found, job.log.reference, GAP)
    moved = se2.transform_from(align(found, job.log.reference, GAP), pair.poses[:, :2])
    return float(np.sqrt(np.nanmean(np.sum((moved - pair.truth[:, :2]) ** 2, axis=1))))
