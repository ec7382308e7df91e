"""Wrong rigs and maps: causal errors of estimators, compared with the errors with the correct rig and map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from benchmarking.ensemble import run_ensemble
from benchmarking.report import Options, Report, ratio_cells

from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.model.log import Log
from factorgraph_loc.simulation.settings import preset
from rfid_benchmark.blind import with_beam

SEEDS = 10
FIRST = 4000  # first seed, not used by other sections
DURATION = 300.0  # s
CONFIGS = {"particle filter": RunConfig("particle_filter"), "smoother": RunConfig("smoother")}
BURSTS = {"duration": 5.0, "share": 0.4}
TOGETHER = 4.5  # with such bursts, so many rounds contain as much information as one independent round


@dataclass(frozen=True)
class Case:
    """A case of a wrong rig or map.

    ``given``, ``true``: parameters of the detection model in the rig, and in the simulation. ``misplaced``: the fraction of tags
    that are 1 m away from their position in the map. ``bursts``: True if reads and misses come in bursts.
    """

    what: str
    given: Mapping[str, float] = field(default_factory=dict)
    true: Mapping[str, float] = field(default_factory=dict)
    misplaced: float = 0.0
    bursts: bool = False


CASES = (
    Case("none"),
    Case("range 20 % too long", {"r_max": 5.4}),
    Case("range 20 % too short", {"r_max": 3.6}),
    Case("read probability 0.9 for 0.5", {"p0": 0.9}, {"p0": 0.5}),
    Case("a tenth of the tags 1 m off", misplaced=0.1),
    Case("a quarter of the tags 1 m off", misplaced=0.25),
    Case("bursts of 5 s, 0.4 of the time", bursts=True),
    Case(
        "range 20 % too long, 0.9 for 0.7, a tenth 1 m off, bursts", {"r_max": 5.4, "p0": 0.9}, {"p0": 0.7}, 0.1, True
    ),
)


def section(options: Options) -> Report:
    report = Report("wrong", options)
    seeds = range(FIRST, FIRST + options.count(SEEDS))
    jobs = {
        (case.what, knows, seed): job(case, knows, seed) for case in CASES for knows in (False, True) for seed in seeds
    }
    outcomes = report.collect(run_ensemble, jobs)
    rows = []
    for name in CONFIGS:
        for case in CASES:
            both = [s for s in seeds if (case.what, False, s) in outcomes and (case.what, True, s) in outcomes]
            mine, theirs = ([outcomes[case.what, knows, s][name] for s in both] for knows in (False, True))
            if both:
                causal = ratio_cells([run.causal for run in mine], [run.causal for run in theirs])
                anees = [f"{np.mean([np.nanmean(run.causal.nees) for run in runs]):.2f}" for runs in (mine, theirs)]
                unsure = np.mean([1.0 - run.share("localized") for run in mine])
                rows.append((case.what, name, *causal, *anees, f"{100 * unsure:.0f} %"))
    report.say(
        f"The table combines {len(seeds)} worlds of `office`, {DURATION:.0f} s each. *Ratio*: causal error, divided by "
        "the error with "
        "the right range, read probability and tags, and with a tempering for bursts. In brackets: 95 % interval over worlds. "
        "*Worst*: the largest ratio of a single world. *ANEES, right*: ANEES of estimators that know these values."
    )
    heads = ("wrong", "estimator", "ratio", "worst", "ANEES", "ANEES, right", "not localized")
    report.table(heads, rows)
    return report


def job(case: Case, knows: bool, seed: int) -> tuple[Any, ...]:
    """Return the arguments of :func:`~benchmarking.ensemble.run_ensemble`. ``knows``: True for the correct rig and map."""
    faults: dict[str, Any] = {"fading": BURSTS} if case.bursts else {}
    if not knows:
        faults["misplaced"] = case.misplaced
    beam: dict[str, Any] = {"models": {"default": {"kind": "beam", **case.true}}}
    if case.bursts and knows:
        beam["tempering"] = 1.0 / TOGETHER
    changes = {"drive": {"duration": DURATION}, "faults": faults, "rig": {"rfid": beam}}
    return preset("office", changes), seed, CONFIGS, partial(told, given={} if knows else case.given)


def told(log: Log, _: int, given: Mapping[str, float]) -> Log:
    """Return the log with the parameters ``given`` in its rig."""
    return replace(log, rig=with_beam(log.rig, **given))
