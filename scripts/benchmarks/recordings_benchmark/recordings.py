"""Results of all estimators on public recordings: position RMSE of causal and final estimates, or the reason for a missing
result."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarking.report import Options, Report

from factorgraph_loc.api.running import run
from factorgraph_loc.errors import FglocError
from factorgraph_loc.files.data_root import find_data_root
from recordings_benchmark.listed import RECORDINGS, Recording
from recordings_benchmark.prepare import prepare

ESTIMATORS = ("dead_reckoning", "ekf", "particle_filter", "switching", "smoother", "batch")
ALONE = ("dead_reckoning", "particle_filter")  # with odometry alone, all other estimators are equal to dead reckoning


Scores = dict[str, dict[str, Any] | str]  # by estimator: the scores, or the reason why there are none


def section(options: Options) -> Report:
    """Return the tables of all recordings."""
    report = Report("recordings", options)
    folder = find_data_root(options.data_root, "recordings")
    jobs = {recording.name: (recording, folder, options.out / "logs") for recording in RECORDINGS}
    found: Mapping[str, Scores] = report.collect(measured, jobs)
    # rows of two tables: logs with a reference and other sensors than odometry, and all other logs
    rows: dict[tuple[str, ...], list[tuple[str, ...]]] = {ESTIMATORS: [], ALONE: []}
    for recording in (recording for recording in RECORDINGS if recording.name in found):
        result = found[recording.name]
        scores = [one for one in result.values() if isinstance(one, dict)]
        scored = max((one.get("causal.scored") or one.get("final.scored") or 0 for one in scores), default=0)
        sensors = recording.odometry + (f"; {recording.others}" if recording.others else "")
        shown = ESTIMATORS if recording.others and scored else ALONE
        cells = (_cell(result[name]) for name in shown)
        rows[shown].append((recording.name, recording.title, sensors, str(scored), *cells))
        for line in sorted({one for one in result.values() if isinstance(one, str)}):
            print(f"{recording.name}: {line}", file=sys.stderr)
    for shown, lines in rows.items():
        report.table(("log", "what it is", "odometry; other sensors", "poses", *shown), lines)
    return report


def measured(recording: Recording, folder: Path, out: Path) -> Scores:
    """Run all estimators on one recording. Returns the scores, or the reason why there are none, by estimator."""
    try:
        log = prepare(recording, folder, out)
    except FglocError as error:
        return {name: str(error).replace(f"{folder}/", "") for name in ESTIMATORS}
    scores: Scores = {}
    for name in ESTIMATORS:
        try:
            scores[name] = run(log, name, prior=recording.prior).scores
        except FglocError as error:
            scores[name] = str(error)
    return scores


def _cell(scores: dict[str, Any] | str) -> str:
    if isinstance(scores, str):
        return "-"
    values = [scores.get(f"{kind}.position_rmse") for kind in ("causal", "final")]
    if all(value is None for value in values):
        return "runs"
    return " / ".join("-" if value is None else f"{value:.3f}" for value in values)
