"""What an update costs, over the length of a log, the rate, the size of the map, and the particles.

Each case has a process of its own, and all times are processor time. What an axis leaves alone is as in :data:`BASE`. Points fill a
larger building as densely; further landmarks, and copies of the hall with its tags, are out of sight.
"""

from __future__ import annotations

import math
import resource
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from benchmarking.report import Options, Report
from speed_benchmark.ours import timed
from speed_benchmark.problems import RIG, SEED, SIGHTINGS

from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.model.log import Log, cut
from factorgraph_loc.sensors.landmarks.settings import Landmark
from factorgraph_loc.simulation import preset, simulate

WARM_UP = 20.0  # s of the log, run before anything is timed
AREA = {"tags": 12.0, "points": 0.6}  # m^2 of the building for each of them
FAR = 1000.0  # m: where landmarks are that no robot of the building sees
HALL, APART = 100, 20.0  # tags of a hall, and m between it and its copies
STREAMS = {"landmarks": "bearing_range", "points": "sightings", "tags": "rfid"}
RUNS: Mapping[str, RunConfig] = {
    "EKF": RunConfig("ekf"),
    "smoother, lag 10 s": RunConfig("smoother", {"lag": 10.0}),
    "particle filter": RunConfig("particle_filter"),
    "smoother, full history": RunConfig("smoother", {"lag": "all"}),
}
WINDOWS = tuple(RUNS)[:3]
BASE: Mapping[str, float] = {"minutes": 2.0, "rate": 5.0, "landmarks": 30}
AXES: Mapping[str, tuple[tuple[int, ...], tuple[str, ...]]] = {
    "minutes": ((10, 60, 600), WINDOWS[:2]),
    "minutes, particles": ((10, 60), WINDOWS[2:]),
    "minutes, full history": ((10, 30, 60), ("smoother, full history",)),
    "rate": ((1, 5, 25), WINDOWS),
    "landmarks": ((30, 1000, 10_000), WINDOWS),
    "tags": ((100, 1000, 10_000), WINDOWS),
    "points": ((500, 2000, 10_000), WINDOWS),
    "particles": ((500, 5000, 50_000), ("particle filter",)),
}
WHAT = {
    "minutes": "length of the log [min]",
    "minutes, particles": "length of the log [min]",
    "minutes, full history": "length of the log [min]",
    "rate": "looks at landmarks [1/s]",
    "landmarks": "landmarks in the map",
    "tags": "tags in the map",
    "points": "points in the map",
    "particles": "particles",
}


@dataclass(frozen=True)
class Case:
    """One run: the axis, the size on it, and the name of the estimator."""

    axis: str
    size: int
    name: str


@dataclass(frozen=True)
class Cost:
    """Milliseconds of an update (median, 99 %, medians of the first and the last quarter), and megabytes that the run took."""

    median: float
    p99: float
    first: float
    last: float
    megabytes: float


def log_of(axis: str, size: int) -> Log:
    """The log of a case."""
    kind = axis if axis in AREA else "landmarks"
    wanted = {**BASE, axis.split(",", maxsplit=1)[0]: size}
    world: dict[str, Any] = {"tags": 1, "landmarks": int(BASE["landmarks"])}
    if kind in AREA:
        count = HALL if kind == "tags" else size
        depth = math.sqrt(0.6 * AREA[kind] * count)
        world = {"plan": "warehouse", "width": depth / 0.6, "depth": depth, "tags": 1, kind: count}
    settings: dict[str, Any] = {"world": world, "drive": {"duration": 60.0 * wanted["minutes"]}}
    if kind == "landmarks":
        settings |= {"rig": RIG, "sightings": {**SIGHTINGS, "rate": wanted["rate"]}}
    elif kind == "points":
        settings |= {"pixels": {"rate": wanted["rate"]}}
    log = simulate(preset("office", settings), SEED)
    sensors = ("odometry", STREAMS[kind])
    copies = int(size) // HALL if kind == "tags" else 1
    steps = [np.array(divmod(i, math.isqrt(copies))) * (world.get("width", 0.0) + APART) for i in range(copies)]
    tags = {
        f"{name}-{i}" if i else name: tag.model_copy(update={"x": tag.x + step[0], "y": tag.y + step[1]})
        for i, step in enumerate(steps)
        for name, tag in log.world.tags.items()
    }
    others = {f"far{i}": Landmark(x=FAR + i, y=FAR) for i in range(int(wanted["landmarks"]) - len(log.world.landmarks))}
    return replace(
        log,
        streams={s: log.streams[s] for s in sensors},
        rig=log.rig.model_copy(update={"sensors": sensors}),
        world=log.world.model_copy(update={"landmarks": {**log.world.landmarks, **others}, "tags": tags}),
    )


def cost_of(case: Case) -> Cost:
    """What one case costs."""
    log, config = log_of(case.axis, case.size), RUNS[case.name]
    if case.axis == "particles":
        config = RunConfig(config.estimator, {"particles": int(case.size)})
    first = log.span()[0]
    timed(cut(log, first, first + WARM_UP), config)
    before = _peak()
    updates = timed(log, config).timings.update_ms
    quarter = len(updates) // 4
    return Cost(
        float(np.median(updates)),
        float(np.quantile(updates, 0.99)),
        float(np.median(updates[:quarter])),
        float(np.median(updates[-quarter:])),
        _peak() - before,
    )


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000.0


def section(options: Options) -> Report:
    report = Report("updates", options)
    cases = [Case(axis, size, name) for axis, (sizes, names) in AXES.items() for name in names for size in sizes]
    labels = [f"{c.axis}, {c.size}, {c.name}" for c in cases]
    found = report.collect(cost_of, cases, labels)
    costs = {cases[i]: found[i] for i in sorted(found)}
    report.say(
        "Processor time of an update [ms]: median, 99 %, and the median of the last quarter over that of the first; memory that "
        f"the run took [MB]. Where a row does not say otherwise: {BASE['minutes']:.0f} minutes, {BASE['rate']:.0f} looks a second, "
        f"{BASE['landmarks']:.0f} landmarks"
    )
    rows = [
        (
            WHAT[c.axis],
            f"{c.size:,}",
            c.name,
            f"{cost.median:.2f}",
            f"{cost.p99:.2f}",
            f"{cost.last / cost.first:.2f}",
            f"{cost.megabytes:.0f}",
        )
        for c, cost in costs.items()
    ]
    report.table(("what grows", "to", "estimator", "median", "99 %", "last / first", "memory"), rows)
    _draw(costs, options)
    return report


def _draw(costs: Mapping[Case, Cost], options: Options) -> None:
    figure, panels = plt.subplots(2, 3, figsize=(11.0, 6.0), sharey=True, layout="constrained")
    names = dict(zip(RUNS, ("C0", "C1", "C2", "C3"), strict=True))
    shown = list(dict.fromkeys(WHAT.values()))
    for axes, what in zip(panels.flat, shown, strict=True):
        for name, color in names.items():
            points = sorted(
                (c.size, cost.median) for c, cost in costs.items() if WHAT[c.axis] == what and c.name == name
            )
            if points:
                axes.plot(*zip(*points, strict=True), "o-", color=color, label=name)
        axes.set(xscale="log", yscale="log", xlabel=what)
        axes.grid(visible=True, alpha=0.3)
    for axes in panels[:, 0]:
        axes.set_ylabel("update, median [ms]")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=len(names))
    (options.out / "updates").mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out / "updates" / "growth.png", dpi=100)
    plt.close(figure)
