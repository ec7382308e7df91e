"""Simulated offices: accuracy, and consistency of the covariances, over many worlds."""

from __future__ import annotations

from benchmarking.ensemble import RunErrors, run_ensemble
from benchmarking.report import ACCURACY, Options, Report, accuracy_cells

from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.simulation.settings import preset

CONFIGS = {"particle filter": RunConfig("particle_filter"), "smoother": RunConfig("smoother")}
PRESETS = {"office": 5, "sparse": 5, "bursty": 3}  # number of worlds
Found = dict[str, list[RunErrors]]  # for each configuration, the errors of each seed


def section(options: Options) -> Report:
    report = Report("office", options)
    found: dict[str, Found] = {}
    for name, usual in PRESETS.items():
        jobs = {(name, seed): (preset(name), seed, CONFIGS) for seed in range(options.count(usual))}
        outcomes = report.collect(run_ensemble, jobs).values()
        if outcomes:
            found[name] = {label: [outcome[label] for outcome in outcomes] for label in CONFIGS}
    worlds = ", ".join(f"{len(runs['smoother'])} worlds of {name}" for name, runs in found.items())
    report.say(
        f"The table combines {worlds}, 10 min each. *Inside*: share of times at which the mean NEES over the worlds is in its "
        "95 % band, ideally 95 %."
    )
    cells = [(name, label, *accuracy_cells(one)) for name, runs in found.items() for label, one in runs.items()]
    report.table(("preset", "estimator", *ACCURACY), cells)
    return report
