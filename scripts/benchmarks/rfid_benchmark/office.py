"""Simulated offices: accuracy, and whether the covariances are right, over many worlds."""

from __future__ import annotations

import numpy as np
from benchmarking.ensemble import EnsembleJob, RunErrors, run_ensemble, stacked
from benchmarking.report import Options, Report, pooled, ratio_cells, together
from benchmarking.statistics import share_in_band

from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.simulation.settings import preset

NOISE = ", constants as noise"
STATES = {"particle filter": RunConfig("particle_filter"), "smoother": RunConfig("smoother")}
BOTH = STATES | {
    label + NOISE: RunConfig(config.estimator, {"self_calibration": False}) for label, config in STATES.items()
}
PRESETS = {"office": (5, BOTH), "sparse": (5, BOTH), "bursty": (3, STATES)}  # number of worlds, runs in each
Found = dict[str, list[RunErrors]]  # of each configuration, one a seed


def section(options: Options) -> Report:
    report = Report("office", options)
    found: dict[str, Found] = {}
    for name, (usual, configs) in PRESETS.items():
        count = options.count(usual)
        jobs = [EnsembleJob(preset(name), seed, configs) for seed in range(count)]
        outcomes = report.collect(run_ensemble, jobs, [f"{name} {seed}" for seed in range(count)])
        if outcomes:
            found[name] = {label: [outcomes[i][label] for i in sorted(outcomes)] for label in configs}
            single = [
                (i, label, *pooled([one.causal]), *pooled([one.final]))
                for i, outcome in sorted(outcomes.items())
                for label, one in outcome.items()
            ]
            heads = ("seed", "estimator", "causal_m", "causal_deg", "final_m", "final_deg")
            report.figures(name, heads, single)
    worlds = ", ".join(f"{len(runs['smoother'])} worlds of {name}" for name, runs in found.items())
    report.say(
        f"{worlds}, 10 min each, pooled. *Inside*: share of times at which ANEES over worlds is in its 95 % band."
    )
    accuracy(report, found)
    report.say(
        "Ratios of pooled position RMSE, with constants as states, a 95 % interval over worlds, and the largest of a single world."
    )
    ratios(report, found)
    return report


def accuracy(report: Report, found: dict[str, Found]) -> None:
    rows = []
    for name, runs in found.items():
        for label, members in runs.items():
            causal, final = [one.causal for one in members], [one.final for one in members]
            (position, heading), (final_position, final_heading) = pooled(causal), pooled(final)
            inside = " / ".join(f"{100 * share_in_band(stacked(kind)):.0f} %" for kind in (causal, final))
            nees = " / ".join(f"{np.nanmean(stacked(kind)):.2f}" for kind in (causal, final))
            p95 = np.percentile(together(final), 95)
            cells = (f"{position:.3f}", f"{heading:.2f}", f"{final_position:.3f}", f"{final_heading:.2f}", f"{p95:.3f}")
            rows.append((name, label, *cells, nees, inside))
    heads = ("preset", "estimator", "causal [m]", "[deg]", "final [m]", "[deg]", "final p95 [m]")
    report.table((*heads, "ANEES causal / final", "inside causal / final"), rows)


def ratios(report: Report, found: dict[str, Found]) -> None:
    rows = []
    for name, runs in found.items():
        both = runs["smoother"], runs["particle filter"]
        causal, final = ([[getattr(one, kind) for one in members] for members in both] for kind in ("causal", "final"))
        rows += [
            (name, "smoother / particle filter, causal", *ratio_cells(*causal)),
            (name, "smoother / particle filter, final", *ratio_cells(*final)),
        ]
    report.table(("preset", "ratio", "pooled (95 %)", "largest"), rows)
