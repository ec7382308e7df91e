"""Results of the estimators on the recordings: position RMSE of causal and final estimates, or why there is none."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarking.report import Options, Report

from factorgraph_loc.api.running import run
from factorgraph_loc.errors import FglocError
from recordings_benchmark.listed import RECORDINGS, Recording
from recordings_benchmark.prepare import prepare

ESTIMATORS = ("dead_reckoning", "ekf", "particle_filter", "switching", "smoother", "batch")
ALONE = ("dead_reckoning", "particle_filter")  # all others are equal to dead reckoning if there is nothing but odometry


@dataclass(frozen=True)
class Job:
    recording: Recording
    folder: Path
    out: Path


@dataclass(frozen=True)
class Found:
    """``scores`` by estimator, or a line with the reason for their absence."""

    scores: dict[str, dict[str, Any] | str]


def section(options: Options) -> Report:
    """The tables."""
    assert options.data_root is not None
    report = Report("recordings", options)
    logs = options.out / "logs"
    jobs = [Job(recording, options.data_root, logs) for recording in RECORDINGS]
    found = report.collect(measured, jobs, [job.recording.name for job in jobs])
    tell(report, [(RECORDINGS[i], result) for i, result in sorted(found.items())])
    return report


def tell(report: Report, results: Sequence[tuple[Recording, Found]]) -> None:
    """Write the tables of results: of scored logs with other sensors than odometry, and of the others; print the reasons for
    missing scores."""
    rows: dict[tuple[str, ...], list[tuple[str, ...]]] = {ESTIMATORS: [], ALONE: []}
    for recording, result in results:
        scores = [one for one in result.scores.values() if isinstance(one, dict)]
        scored = max((one.get("causal.scored") or one.get("final.scored") or 0 for one in scores), default=0)
        sensors = recording.odometry + (f"; {recording.others}" if recording.others else "")
        shown = ESTIMATORS if recording.others and scored else ALONE
        cells = (_cell(result.scores[name]) for name in shown)
        rows[shown].append((recording.name, recording.title, sensors, str(scored), *cells))
        for line in sorted({one for one in result.scores.values() if isinstance(one, str)}):
            print(f"{recording.name}: {line}", file=sys.stderr)
    for shown, lines in rows.items():
        report.table(("log", "what it is", "odometry; other sensors", "poses", *shown), lines)


def measured(job: Job) -> Found:
    """Every estimator on one recording."""
    recording = job.recording
    try:
        log = prepare(recording, job.folder, job.out)
    except FglocError as error:
        return Found({name: str(error).replace(f"{job.folder}/", "") for name in ESTIMATORS})
    scores: dict[str, dict[str, Any] | str] = {}
    for name in ESTIMATORS:
        try:
            scores[name] = run(log, name, prior=recording.prior).scores
        except FglocError as error:
            scores[name] = str(error)
    return Found(scores)


def _cell(scores: dict[str, Any] | str) -> str:
    if isinstance(scores, str):
        return "-"
    values = [scores.get(f"{kind}.position_rmse") for kind in ("causal", "final")]
    if all(value is None for value in values):
        return "runs"
    return " / ".join("-" if value is None else f"{value:.3f}" for value in values)
