"""Calibration without a reference: a rig is learnt on some simulated offices, and the smoother is run with this rig in others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from benchmarking.ensemble import RunErrors, run_errors
from benchmarking.report import Options, Report, ratio_cells

from factorgraph_loc.api.learning import calibrate
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.simulation import preset, simulate

LEARNT_ON, TRIED_ON = range(1, 6), range(6, 16)  # seeds of the offices for learning, and for the runs
DURATION = 300.0  # s


@dataclass(frozen=True)
class Case:
    """A parameter of the detection model that is wrong in the rig before calibration. ``key``: its name. ``true``: its value in the
    simulation. ``given``: its value in the rig."""

    what: str
    key: str
    true: float
    given: float


CASES = (
    Case("range 20 % too long", "r_max", 4.5, 5.4),
    Case("range 20 % too short", "r_max", 4.5, 3.6),
    Case("read probability too high", "p0", 0.5, 0.9),
)


@dataclass(frozen=True)
class Learnt:
    rig: Rig
    value: float
    error: float


def section(options: Options) -> Report:
    report = Report("blind", options)
    jobs = {case.what: (case, options.out / "blind") for case in CASES}
    found: Mapping[str, Learnt] = report.collect(learnt, jobs)
    seeds = TRIED_ON[: options.count(len(TRIED_ON))]
    trials = {
        (case.what, learns, seed): (case, seed, found[case.what].rig if learns else None)
        for case in CASES
        if case.what in found
        for learns in (True, False)
        for seed in seeds
    }
    runs: Mapping[tuple[str, bool, int], RunErrors] = report.collect(tried, trials)
    rows = []
    for case in (case for case in CASES if case.what in found):
        one = found[case.what]
        mine, theirs = (
            [run.causal for key, run in runs.items() if key[:2] == (case.what, learns)] for learns in (True, False)
        )
        anees = [f"{np.mean([np.nanmean(run.nees) for run in group]):.2f}" for group in (mine, theirs)]
        values = (f"`{case.key}` {case.given:g}", f"{case.true:g}", f"{one.value:.3f} ± {one.error:.3f}")
        rows.append((case.what, *values, *ratio_cells(mine, theirs), *anees))
    report.say(
        f"Logs of `office` have {DURATION:.0f} s. The rig is learnt on seeds {LEARNT_ON[0]} to {LEARNT_ON[-1]} and "
        f"tested on {seeds[0]} to {seeds[-1]}. "
        "*Ratio*: causal error of the smoother with the learnt rig, divided by its error with the rig of the simulation. In "
        "brackets: 95 % interval over worlds. *Worst*: the largest ratio of a single world."
    )
    heads = (
        "error of the input rig",
        "input rig",
        "simulation",
        "learnt",
        "ratio",
        "worst",
        "ANEES",
        "ANEES, rig of the simulation",
    )
    report.table(heads, rows)
    return report


def office(case: Case, seed: int) -> Log:
    beam = {case.key: case.true}
    changes = {"drive": {"duration": DURATION}, "rig": {"rfid": {"models": {"default": beam}}}}
    return simulate(preset("office", changes), seed)


def with_beam(rig: Rig, **changes: float) -> Rig:
    """Return the rig with other parameters of the detection model."""
    assert rig.rfid is not None
    models = {"default": rig.rfid.models["default"].model_copy(update=changes)}
    return rig.model_copy(update={"rfid": rig.rfid.model_copy(update={"models": models})})


def learnt(case: Case, out: Path) -> Learnt:
    """Calibrate a wrong rig on logs without references."""
    logs = [replace(office(case, seed), reference=None) for seed in LEARNT_ON]
    out.mkdir(parents=True, exist_ok=True)
    rig = with_beam(logs[0].rig, **{case.key: case.given})
    found = calibrate(logs, out / f"{case.key}-{case.given:g}.rig.toml", rig=rig, overwrite=True)
    constant = next(c for c in found.knowledge.constants if c.sensor == "rfid" and c.name.endswith(case.key))
    return Learnt(found.rig, constant.fitted, constant.error)


def tried(case: Case, seed: int, rig: Rig | None) -> RunErrors:
    """Run the smoother on an office with a rig, and return its errors. ``rig``: None uses the rig of the simulation."""
    log = office(case, seed)
    return run_errors(run(replace(log, rig=rig or log.rig), RunConfig("smoother")), log)
