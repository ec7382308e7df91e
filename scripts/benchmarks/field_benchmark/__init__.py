"""Benchmark of faults that the rig does not contain: the errors of the estimators, and the faults that they detect."""

from __future__ import annotations

from functools import partial

import numpy as np
from benchmarking.report import Options, Report

import factorgraph_loc as fgloc
from field_benchmark.cases import CASES

ESTIMATORS = ("smoother", "ekf", "particle_filter")
SEEDS = 3
HEADS = ("estimator", "seed", "causal [m]", "without the fault [m]", "largest [m]", "final [m]")
HEADS += ("ANEES causal / final", "wrong [s]", "named")
WRONG = 0.5  # m


def section(name: str, options: Options) -> Report:
    """Run all estimators on a case, and return its table. ``name``: a key of :data:`CASES`."""
    report = Report(name, options)
    jobs = {(e, seed): (name, seed, e) for e in ESTIMATORS for seed in range(1, options.count(SEEDS) + 1)}
    rows = report.collect(figures, jobs)
    report.say(f"`wrong`: time for which the estimate is more than {WRONG} m off while its status is `localized`.")
    report.table(HEADS, [(*map(str, key), *cells) for key, cells in rows.items()])
    return report


def figures(name: str, seed: int, estimator: str) -> tuple[str, ...]:
    """Run an estimator on a case with and without the fault. Returns the cells of a row."""
    log, right = CASES[name](seed)
    run, without = fgloc.run(log, estimator), fgloc.run(right, estimator)
    result, scores = run.result, run.scores
    inside = (result.t >= log.reference.t[0]) & (result.t <= log.reference.t[-1])
    error = np.hypot(*(result.poses[inside, :2] - log.reference.at(result.t[inside])[:, :2]).T)
    localized = np.array([str(status) for status in result.status])[inside] == "localized"
    wrong = np.sum((error > WRONG) & localized) * np.median(np.diff(result.t))
    named = [f"{len(tags)} {kind}" for kind, tags in result.diagnostics.doubted.items() if tags]
    named += [
        f"{name} {result.learnt.values[f'rfid.{name}'][0]:.3f}"
        for name in ("yaw", "time_offset")
        if f"rfid.{name}" in result.learnt.values
    ]
    errors = (
        scores["causal.position_rmse"],
        without.scores["causal.position_rmse"],
        error.max(),
        scores["final.position_rmse"],
    )
    anees = f"{scores['causal.anees']:.1f} / {scores['final.anees']:.1f}"
    return (*(f"{value:.3f}" for value in errors), anees, f"{wrong:.1f}", ", ".join(named))


SECTIONS = {name: partial(section, name) for name in CASES}
