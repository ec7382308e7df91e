"""A hall of 100 x 60 m: unknown starts, two kidnappings in one run, and the computing time of a scan by the size of the map."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from benchmarking.report import Options, Report, share_text
from benchmarking.trials import BEFORE, HOLD, JUMP, is_right

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log, cut, join
from factorgraph_loc.simulation import simulate
from factorgraph_loc.simulation.settings import SimulationSettings, preset
from rfid_benchmark.simulated_trials import Clock, SimulatedTrial, held, lasting, started

SEEDS = 5
FIRST = 3000  # first seed, not used by other sections
ESTIMATORS = ("smoother", "particle_filter")
TAGS = (500, 10_000)
START, RETURN = 15.0, 20.0  # s: deadlines after a start, and after a kidnapping
DENSITY, SIZES = 500 / 6000, (100, 1000, 10_000)  # tags per m^2, and numbers of tags
RATIO = 0.6  # depth over width of the hall
SCANS = 30.0  # s: duration of a drive on which scans are timed


@dataclass(frozen=True)
class Job:
    """A log on which all estimators are run. ``what``: "start" (unknown start), "return" (two kidnappings) or "scan" (computing
    time).
    ``tags``: number of tags."""

    what: str
    tags: int
    seed: int


@dataclass(frozen=True)
class Returns:
    """The result of a run with two kidnappings.

    ``seconds``: the time from each kidnapping until the estimate was correct, NaN if it never was. ``false``: True if the status
    was localized at a deadline although the estimate was wrong. ``worst`` [m]: the largest error of the final trajectory.
    ``busy_ms``: see :class:`.SimulatedTrial`.
    """

    seconds: tuple[float, ...]
    false: bool
    worst: float
    busy_ms: tuple[float, ...]


def hall(tags: int, width: float = 100.0) -> SimulationSettings:
    """Return the settings of a simulated hall with ``tags`` tags on shelves. ``width`` [m]."""
    # the drive is short, because a long drive among 10,000 tags exceeds the limit of simulated observations
    world = {"width": width, "depth": RATIO * width, "tags": tags}
    return preset("warehouse", {"world": world, "drive": {"duration": SCANS}})


def section(options: Options) -> Report:
    report = Report("hall", options)
    seeds = range(FIRST, FIRST + options.count(SEEDS))
    jobs = [Job(what, tags, seed) for what in ("start", "return") for tags in TAGS for seed in seeds]
    jobs += [Job("scan", tags, FIRST) for tags in SIZES]
    outcomes = report.collect(measured, {(job.what, job.tags, job.seed): (job,) for job in jobs})
    report.say(
        f"Each row has {len(seeds)} runs in a hall of 100 x 60 m, each in a new world. *Right in time*: the pose is "
        "right for 10 s, "
        f"beginning within {START:.0f} s of an unknown start (*start*), or within {RETURN:.0f} s after the robot is carried away "
        "(*return*, twice in each run). *Busy*: processor time for 0.1 s of the log, 99.9th percentile / largest."
    )
    rows: list[tuple[str, ...]] = []
    groups: dict[tuple[str, int, str], list[Any]] = {}
    for (what, tags, _), by_name in outcomes.items():
        for name, outcome in by_name.items():
            groups.setdefault((what, tags, name), []).append(outcome)
    for (what, tags, name), found in groups.items():
        if what != "scan":
            rows.append((what, f"{tags:,}", name, *row(found)))
    heads = ("", "tags", "estimator", "right in time", "median [s]", "false claims")
    report.table((*heads, "busy [ms]", "largest final error [m]"), rows)
    times = {(name, tags): found[0] for (what, tags, name), found in groups.items() if what == "scan"}
    report.say(
        f"The next table has the median processor time [ms] of a scan and its estimate, at {DENSITY:.3f} tags per m^2."
    )
    cells = [
        (name, *(f"{times[name, tags]:.2f}" if (name, tags) in times else "–" for tags in SIZES)) for name in ESTIMATORS
    ]
    report.table(("estimator", *(f"{tags:,} tags" for tags in SIZES)), cells)
    return report


def row(found: list[SimulatedTrial | Returns]) -> tuple[str, ...]:
    starts = [t for t in found if isinstance(t, SimulatedTrial)]
    returns = [t for t in found if isinstance(t, Returns)]
    seconds = [t.seconds for t in starts] + [s for t in returns for s in t.seconds]
    deadline = START if starts else RETURN
    busy = np.concatenate([t.busy_ms for t in found])
    known = np.where(np.isnan(seconds), np.inf, seconds)
    worst = f"{max(t.worst for t in returns):.2f}" if returns else "–"
    return (
        share_text(int(np.sum(known <= deadline)), len(known)),
        f"{np.median(known):.1f}",
        share_text(sum(t.false for t in found), len(found)),
        f"{np.percentile(busy, 99.9):.0f} / {busy.max():.0f}",
        worst,
    )


def measured(job: Job) -> dict[str, SimulatedTrial | Returns | float]:
    """Run all estimators on a job. Returns the results by estimator; for a job of the kind "scan" the computing time of a scan
    [ms]."""
    log, moved = moved_log(job) if job.what == "return" else (drive(job), [])
    found: dict[str, SimulatedTrial | Returns | float] = {}
    for name in ESTIMATORS:
        rehearse(name)
        if job.what == "start":
            found[name] = started(log, name, job.seed)
        else:
            found[name] = returns(log, moved, name, job.seed) if moved else scan_ms(log, name, job.seed)
    return found


def rehearse(estimator: str) -> None:
    """Run an estimator with an unknown start and a kidnapping in a small world, so that later runs measure no compilation."""
    settings = lasting(preset("office", {"drive": {"duration": 20.0}}).model_copy(update={"world_seed": 1}), 20.0)
    run(join(simulate(settings, 1), simulate(settings, 2), gap=JUMP), RunConfig(estimator, prior="unknown"))


def drive(job: Job) -> Log:
    """Return the log of a job of the kind "start" or "scan"."""
    if job.what == "start":
        return simulate(lasting(hall(job.tags), START + HOLD + 1.0), job.seed)
    width = math.sqrt(job.tags / DENSITY / RATIO)
    return simulate(lasting(hall(job.tags, width), SCANS), job.seed)


def moved_log(job: Job) -> tuple[Log, list[float]]:
    """Return a log with two kidnappings to random places of the same hall, and the times of the kidnappings."""
    after = RETURN + HOLD + 1.0
    world = hall(job.tags).model_copy(update={"world_seed": job.seed})
    log, moved = cut(simulate(lasting(world, BEFORE), 3 * job.seed), 0.0, BEFORE), []
    for k in (1, 2):
        moved.append(log.span()[1] + JUMP)
        log = join(log, cut(simulate(lasting(world, after), 3 * job.seed + k), 0.0, after), gap=JUMP)
    return log, moved


def returns(log: Log, moved: list[float], estimator: str, seed: int) -> Returns:
    """Run an estimator with a known start on a log with kidnappings at the times ``moved`` [s], and return how it recovered."""
    clock = Clock()
    result = run(log, RunConfig(estimator, prior="reference", seed=seed), watch=clock)
    good, localized = is_right(result, log), np.array(result.status) == "localized"
    seconds, false = [], False
    for begin in moved:
        until = result.t < min((m for m in moved if m > begin), default=math.inf)
        seconds.append(held(result, good & until, begin))
        at = int(np.searchsorted(result.t, begin + RETURN))
        false |= bool(localized[at]) and not bool(good[at])
    assert log.reference is not None
    truth = log.reference.at(result.final.t, max_gap=0.1)
    error = np.hypot(*(result.final.poses[:, :2] - truth[:, :2]).T)
    return Returns(tuple(seconds), false, float(np.nanmax(error)), tuple(clock.busy_ms[1:]))


def scan_ms(log: Log, estimator: str, seed: int) -> float:
    """Return the median processor time [ms] of a scan, measured over the tenth of a second of the log that contains the scan."""
    clock = Clock()
    run(log, RunConfig(estimator, prior="reference", seed=seed), watch=clock)
    scans = len(np.unique(log.streams["rfid"].t))
    return float(np.median(np.sort(clock.busy_ms[1:])[-scans:]))
