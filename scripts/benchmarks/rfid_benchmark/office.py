"""Simulated offices: accuracy, and consistency of the covariances, over many worlds."""

from __future__ import annotations

from benchmarking.ensemble import RunErrors, run_ensemble
from benchmarking.report import ACCURACY, KINDS, Options, Report, accuracy_cells, ratio_cells

from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.simulation.settings import preset

NOISE = ", constants as noise"
STATES = {"particle filter": RunConfig("particle_filter"), "smoother": RunConfig("smoother")}
BOTH = STATES | {
    label + NOISE: RunConfig(config.estimator, {"self_calibration": False}) for label, config in STATES.items()
}
PRESETS = {"office": (5, BOTH), "sparse": (5, BOTH), "bursty": (3, STATES)}  # number of worlds, runs in each
Found = dict[str, list[RunErrors]]  # for each configuration, the errors of each seed


def section(options: Options) -> Report:
    report = Report("office", options)
    found: dict[str, Found] = {}
    for name, (usual, configs) in PRESETS.items():
        jobs = {(name, seed): (preset(name), seed, configs) for seed in range(options.count(usual))}
        outcomes = report.collect(run_ensemble, jobs).values()
        if outcomes:
            found[name] = {label: [outcome[label] for outcome in outcomes] for label in configs}
    worlds = ", ".join(f"{len(runs['smoother'])} worlds of {name}" for name, runs in found.items())
    report.say(
        f"The table combines {worlds}, 10 min each. *Inside*: share of times at which the ANEES over worlds is in its 95 % band."
    )
    cells = [(name, label, *accuracy_cells(one)) for name, runs in found.items() for label, one in runs.items()]
    report.table(("preset", "estimator", *ACCURACY), cells)
    report.say(
        "The next table has ratios of position RMSE, with constants as states. *Pooled*: over all worlds, with a 95 % interval. "
        "*Largest*: the largest ratio of a single world."
    )
    rows = []
    for name, runs in found.items():
        for kind in KINDS:
            both = ([getattr(one, kind) for one in runs[label]] for label in ("smoother", "particle filter"))
            rows.append((name, f"smoother / particle filter, {kind}", *ratio_cells(*both)))
    report.table(("preset", "ratio", "pooled (95 %)", "largest"), rows)
    return report
