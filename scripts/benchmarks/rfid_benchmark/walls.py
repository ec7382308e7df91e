"""Walls that attenuate reads, of which the map tells or does not: errors against those where walls do nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from benchmarking.ensemble import EnsembleJob, run_ensemble
from benchmarking.report import Options, Report, ratio_cells

from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.model.log import Log
from factorgraph_loc.simulation.settings import preset

SEEDS = 10
FIRST = 5000  # first seed, not used by other sections
DURATION = 300.0  # s
ATTENUATION = 3.0  # dB, which leaves a little less than half of the reads through walls
CONFIGS = {name: RunConfig(name) for name in ("ekf", "particle_filter", "smoother")}
KINDS = ("nothing", "3 dB, told in the map", "3 dB, not told")


def section(options: Options) -> Report:
    report = Report("walls", options)
    seeds = range(FIRST, FIRST + options.count(SEEDS))
    jobs = {(kind, seed): job(kind, seed) for kind in KINDS for seed in seeds}
    found = report.collect(run_ensemble, list(jobs.values()), [f"{kind}, {seed}" for kind, seed in jobs])
    outcomes = {key: found[i] for i, key in enumerate(jobs) if i in found}
    rows = []
    for name in CONFIGS:
        for kind in KINDS:
            both = [s for s in seeds if (KINDS[0], s) in outcomes and (kind, s) in outcomes]
            if not both:
                continue
            open_, mine = ([outcomes[k, s][name] for s in both] for k in (KINDS[0], kind))
            causal = ratio_cells([run.causal for run in mine], [run.causal for run in open_])
            final = ratio_cells([run.final for run in mine], [run.final for run in open_])
            anees = f"{np.mean([np.nanmean(run.causal.nees) for run in mine]):.2f}"
            rows.append((kind, name, *causal, anees, *final))
    report.say(
        f"`office`, {len(seeds)} worlds of {DURATION:.0f} s, in which walls and furniture do nothing to reads, or attenuate them. "
        "*Ratio*: of the error to that where they do nothing, with its 95 % interval over worlds, and the largest of a single world"
    )
    report.table(("walls", "estimator", "causal ratio", "worst", "ANEES", "final ratio", "worst"), rows)
    return report


def job(kind: str, seed: int) -> EnsembleJob:
    world = {} if kind == KINDS[0] else {"wall_attenuation": ATTENUATION}
    settings = preset("office", {"drive": {"duration": DURATION}, "world": world})
    return EnsembleJob(settings, seed, CONFIGS, untold if kind == KINDS[2] else None)


def untold(log: Log, _: int) -> Log:
    """The log with a map that tells nothing of what walls do."""
    return replace(log, world=log.world.model_copy(update={"wall_attenuation": None}))
