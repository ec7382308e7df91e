"""Estimators compared with nearly optimal ones: a grid filter in a small room, and a particle smoother in an office."""

from __future__ import annotations

import numpy as np
from benchmarking.ensemble import Series, run_ensemble, run_errors, series
from benchmarking.report import Options, Report, pooled, ratio_cells

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.simulation import simulate
from factorgraph_loc.simulation.settings import preset
from rfid_benchmark.optimal import optimal_filter, without_constants

ROOMS, OFFICES = 20, 10
ROOM = {"world": {"plan": "hall", "width": 6, "depth": 4, "tags": 8}, "drive": {"duration": 60}}
FILTERS = {
    "grid filter": None,
    "particle filter": RunConfig("particle_filter", {"smooth": False}),
    "smoother": RunConfig("smoother"),
}
SMOOTHERS = {
    "smoother": RunConfig("smoother"),
    "particle smoother": RunConfig("particle_filter", {"smoothing_trajectories": 200, "smoothing_interval": 0.5}),
}


def section(options: Options) -> Report:
    report = Report("optimum", options)
    rooms, offices = options.count(ROOMS), options.count(OFFICES)
    outcomes = report.collect(in_room, {("room", seed): (seed,) for seed in range(rooms)}).values()
    report.say(
        f"Each of {len(outcomes)} worlds is a room of 6 x 4 m with 8 tags, and a drive of 60 s. Causal estimates are scored at the "
        "scans. *Ratio*: error divided by the error of the grid filter (cells of 5 cm and 3 degrees), which is optimal."
    )
    table(report, {label: [outcome[label] for outcome in outcomes] for label in FILTERS}, "grid filter")
    jobs = {("office", seed): (preset("office"), seed, SMOOTHERS) for seed in range(offices)}
    outcomes = report.collect(run_ensemble, jobs).values()
    report.say(
        f"The next table is for final estimates in {len(outcomes)} worlds of `office`. *Ratio*: error divided by the error of a "
        "particle smoother with the same states, 5,000 particles and 200 trajectories that are drawn backwards."
    )
    finals = {label: [outcome[label].final for outcome in outcomes] for label in SMOOTHERS}
    table(report, finals, "particle smoother")
    return report


def table(report: Report, found: dict[str, list[Series]], optimal: str) -> None:
    rows = []
    for label, runs in found.items():
        if runs:
            position, heading = pooled(runs)
            nees = np.mean([np.nanmean(one.nees) for one in runs])
            ratios = ("1", "–") if label == optimal else ratio_cells(runs, found[optimal])
            rows.append((label, f"{position:.4f}", f"{heading:.4f}", f"{nees:.2f}", *ratios))
    report.table(("estimator", "RMSE [m]", "heading [rad]", "ANEES", "ratio (95 %)", "largest"), rows)


def in_room(seed: int) -> dict[str, Series]:
    """Run all filters in a small room. Returns their causal errors at the scans, by label."""
    log = without_constants(simulate(preset("office", ROOM), seed), seed)
    best = series(optimal_filter(log), log)
    found = {"grid filter": best}
    for label, config in FILTERS.items():
        if config is not None:
            causal = run_errors(run(log, config), log).causal
            found[label] = causal.where(np.min(np.abs(causal.t[:, None] - best.t), axis=1) < 1e-6)
    return found
