"""What a map of points costs, over the keyframes that it is made from."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarking.report import Options, Report

from factorgraph_loc import simulate
from factorgraph_loc.experiments.maps import make_map
from factorgraph_loc.model.log import cut

SIZES = (100, 400, 1600)  # images
RATE = 2.0  # images per second
SEED = 7
REHEARSAL = 10.0  # s of the log that are mapped before anything is timed


@dataclass(frozen=True)
class Cost:
    """Images, keyframes and observations of a map, processor time [s] of its features and points, and peak memory [MB]."""

    images: int
    keyframes: int
    observations: int
    features: float
    points: float
    megabytes: float


def cost_of(images: int) -> Cost:
    """What the map of one drive costs."""
    changes = {"world": {"tags": 1}, "drive": {"duration": images / RATE}, "images": {"rate": RATE}}
    seconds: dict[str, float] = {}

    @contextmanager
    def stages(name: str) -> Iterator[Callable[[float, float], None]]:
        started = _processor_time()
        yield lambda _done, _total: None
        seconds[name] = _processor_time() - started

    with TemporaryDirectory() as folder:
        os.environ["FGLOC_CACHE"] = str(Path(folder) / "cache")  # features are those of these images alone
        log = simulate("office", SEED, changes=changes, images=True, out=Path(folder) / "drive")
        make_map(cut(log, 0.0, REHEARSAL))
        made = make_map(log, stages=stages)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000.0
    return Cost(images, made.details.keyframes, made.details.observations, seconds["features"], seconds["points"], peak)


def _processor_time() -> float:
    """Of this process and of those that it started and that ended [s]."""
    return sum(os.times()[:4])


def section(options: Options) -> Report:
    report = Report("keyframes", options)
    costs = report.collect(cost_of, SIZES, [f"{size} images" for size in SIZES])
    report.say(
        "A map of points from one drive through an office. Processor time [s]: features of an image, points of a keyframe; "
        "and peak memory [MB]"
    )
    rows = [
        (
            f"{cost.images:,}",
            f"{cost.keyframes:,}",
            f"{cost.observations:,}",
            f"{cost.features / cost.images:.3f}",
            f"{cost.points / cost.keyframes:.3f}",
            f"{cost.megabytes:.0f}",
        )
        for _, cost in sorted(costs.items())
    ]
    report.table(("images", "keyframes", "observations", "features", "points", "memory"), rows)
    return report
