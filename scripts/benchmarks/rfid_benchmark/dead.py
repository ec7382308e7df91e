"""Dead tags: the cost of not knowing them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from benchmarking.ensemble import EnsembleJob, RunErrors, Series, run_ensemble
from benchmarking.report import Options, Report, pooled, ratio_cells

from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.model.log import Log
from factorgraph_loc.simulation.settings import preset

SEEDS = 10
FIRST = 1
DURATION = 90.0  # s
FOUND_OUT = 30.0  # s after which a robot has passed most tags
SHARES = (0.0, 0.3)
CONFIGS = {"particle filter": RunConfig("particle_filter"), "smoother": RunConfig("smoother")}


def told(log: Log, _: int) -> Log:
    """The log with a map without the dead tags, and a rig that assumes the others alive."""
    dead = set(log.metadata.get("dead", "").split(", "))
    tags = {name: tag for name, tag in log.world.tags.items() if name not in dead}
    assert log.rig.rfid is not None
    rig = log.rig.model_copy(update={"rfid": log.rig.rfid.model_copy(update={"dead_tags": 0.0})})
    return replace(log, rig=rig, world=log.world.model_copy(update={"tags": tags}))


def section(options: Options) -> Report:
    report = Report("dead", options)
    count = options.count(SEEDS)
    jobs = [
        EnsembleJob(
            preset("office", {"drive": {"duration": DURATION}, "faults": {"dead": share}}), seed, CONFIGS, change
        )
        for share in SHARES
        for change in (None, told)
        for seed in range(FIRST, FIRST + count)
    ]
    outcomes = report.collect(run_ensemble, jobs, [f"{job.settings.faults.dead:.0%} dead, {job.seed}" for job in jobs])
    report.say(
        f"`office`, {count} worlds of {DURATION:.0f} s, position RMSE [m], pooled. *Told*: the map has no dead tag, and the "
        "rig says so. Then the ratio to it with its 95 % interval over worlds, and the largest of a single world"
    )
    rows = []
    for estimator in CONFIGS:
        for share in SHARES:
            of_share = [
                (jobs[i], outcomes[i][estimator]) for i in sorted(outcomes) if jobs[i].settings.faults.dead == share
            ]
            alone = {job.seed: one for job, one in of_share if job.change is None}
            helped = {job.seed: one for job, one in of_share if job.change is not None}
            seeds = sorted(alone.keys() & helped.keys())
            if seeds:
                rows.append((f"{share:.0%}", estimator, *cells([alone[s] for s in seeds], [helped[s] for s in seeds])))
    report.table(("dead", "estimator", "causal", f"causal, t > {FOUND_OUT:.0f} s", "final"), rows)
    return report


def cells(alone: list[RunErrors], helped: list[RunErrors]) -> list[str]:
    parts: tuple[Callable[[RunErrors], Series], ...] = (
        lambda one: one.causal,
        lambda one: later(one.causal),
        lambda one: one.final,
    )
    out = []
    for part in parts:
        mine, theirs = [part(one) for one in alone], [part(one) for one in helped]
        ratio, worst = ratio_cells(mine, theirs)
        out.append(f"{pooled(mine)[0]:.3f}, told {pooled(theirs)[0]:.3f}: {ratio}, {worst}")
    return out


def later(series: Series) -> Series:
    return series.where(series.t > FOUND_OUT)
