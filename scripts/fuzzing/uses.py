"""Uses of the files of each format: they are read, inspected, written and shown."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.random import Generator

import factorgraph_loc as fgloc
from factorgraph_loc.experiments.experiment import prepare
from factorgraph_loc.experiments.reporting import report_experiment
from factorgraph_loc.experiments.result_table import load_results
from factorgraph_loc.exports.foxglove import write_mcap
from factorgraph_loc.exports.rerun_scene import write_rrd
from factorgraph_loc.exports.runs import find_runs, read_runs
from factorgraph_loc.exports.trajectories import pose_graph, write_g2o, write_kitti
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.scoring import ALIGNMENTS, ASSOCIATIONS
from factorgraph_loc.sensors.camera.stream import ImageStream
from factorgraph_loc.simulation import named_settings
from factorgraph_loc.vision.images import read_image
from fuzzing import foreign_seeds, seeds
from fuzzing.absurd import pick
from fuzzing.verdicts import WrongResultError, fault_of

Use = Callable[[Path, Generator], None]
LONGEST_WARNING = 600  # letters


@dataclass(frozen=True)
class Format:
    """``make`` writes the seed; ``use`` reads a folder. ``damaged``: prefixes or suffixes of the paths that are damaged, by
    default all. ``weight``: relative frequency."""

    make: Callable[[Path], None]
    use: Use
    damaged: tuple[str, ...] = ()
    weight: int = 2


def a_log(path: str, folder: Path, rng: Generator, *, reader: str | None = None, **options: object) -> None:
    """Read a log, and apply a random operation for logs."""
    for log in fgloc.load(str(folder / path), reader=reader, options=options):
        check_log(log)
        look_at(log, folder / "made", rng)


def a_score(folder: Path, rng: Generator) -> None:
    """Score two files of poses, and read one of them as a log."""
    estimate, reference = (folder / pick(rng, foreign_seeds.POSES) for _ in range(2))
    has_stamps = ".kitti" not in (estimate.suffix, reference.suffix)
    associate = pick(rng, ASSOCIATIONS) if has_stamps else "nearest"
    found = fgloc.score(
        estimate, reference, align=pick(rng, ALIGNMENTS), associate=associate, max_diff=0.1, max_gap=2.0
    )
    if not all(value is None or np.isfinite(value) for value in found.figures.values()):
        raise WrongResultError("a figure is not finite")
    a_log(estimate.name, folder, rng, reader="trajectory", use=pick(rng, ("reference", "odometry")))


def check_log(log: Log) -> None:
    for text in log.warnings:
        if fault := fault_of(text, LONGEST_WARNING):
            raise WrongResultError(f"a warning is a {fault}: {text[:80]!r}")
    for name, stream in log.streams.items():
        if not np.isfinite(stream.t).all():
            raise WrongResultError(f"stamps of {name} are not finite")


def look_at(log: Log, out: Path, rng: Generator) -> None:
    if rng.random() < 0.5:
        pick(rng, LOOKS)(log, out, rng)


def _inspect(log: Log, _out: Path, _rng: Generator) -> None:
    fgloc.info(log)


def _convert(log: Log, out: Path, rng: Generator) -> None:
    fgloc.convert(log, out, format="csv" if rng.random() < 0.5 else "parquet")
    fgloc.load(str(out))


def _to_bag(log: Log, out: Path, rng: Generator) -> None:
    fgloc.convert(log, out.with_suffix(pick(rng, (".bag", ".mcap", ".db3"))))


def _to_foxglove(log: Log, out: Path, _rng: Generator) -> None:
    write_mcap(log, [], out.with_suffix(".mcap"))


def _to_rerun(log: Log, out: Path, rng: Generator) -> None:
    if rng.random() < 0.2:  # slow
        write_rrd(log, [], out.with_suffix(".rrd"))


def _to_kitti(log: Log, out: Path, _rng: Generator) -> None:
    if (reference := log.reference or log.reference3) is not None:
        write_kitti(reference, out.with_suffix(".kitti"))


def _see_images(log: Log, _out: Path, _rng: Generator) -> None:
    if isinstance(images := log.streams.get("camera"), ImageStream):
        for file in images.file[:2]:
            if file is not None:
                read_image(Path(file))


def _run(log: Log, _out: Path, rng: Generator) -> None:
    if rng.random() < 0.5:
        fgloc.run(log, "dead_reckoning")


LOOKS = (_inspect, _convert, _to_bag, _to_foxglove, _to_rerun, _to_kitti, _see_images, _run)


def warm_up(folder: Path) -> None:
    """Imports and compilation, which take long once per process."""
    (log,) = fgloc.load(str(folder))
    write_rrd(log, [], folder / "made.rrd")
    fgloc.run(log, "dead_reckoning")
    for look in LOOKS:
        look(log, folder / look.__name__, np.random.default_rng(0))


def a_rig(path: str, folder: Path, _: Generator) -> None:
    rig = fgloc.read_rig(folder / path)
    fgloc.write_rig(rig, folder / "made.rig.toml")
    if rig.rfid is not None:
        for model in rig.rfid.models.values():
            model.model()


def a_world(path: str, folder: Path, _: Generator) -> None:
    world = fgloc.read_world(folder / path)
    fgloc.write_world(world, folder / "made.world.toml")


def a_simulation(folder: Path, _: Generator) -> None:
    named_settings(str(folder / "sim.toml"), None)


def a_result(folder: Path, rng: Generator) -> None:
    log = fgloc.read_log(folder / "log")
    runs = read_runs(find_runs(folder / "run"), log)
    if rng.random() < 0.3:
        write_mcap(log, runs, folder / "x.mcap")
    if rng.random() < 0.3:
        sensors = runs[0].folder.config.sensors or log.rig.sensors
        write_g2o(pose_graph(log, runs[0].final, sensors, runs[0].landmarks), folder / "x.g2o")
    if rng.random() < 0.1:
        write_rrd(log, runs, folder / "x.rrd", {})


def an_experiment(folder: Path, _: Generator) -> None:
    prepare(folder / "e.toml", out=folder / "out")


def a_store(folder: Path, rng: Generator) -> None:
    prepared = prepare(folder / "e.toml", out=folder / "out", verify=bool(rng.random() < 0.5))
    for run in prepared.runs:
        if prepared.states[run.key] in ("ok", "failed"):
            prepared.store.row(run.key)
    if rng.random() < 0.2:
        report_experiment(prepared, folder / "page.html")
    load_results(folder / "out")


FORMATS: dict[str, Format] = {
    "native": Format(seeds.csv, partial(a_log, ""), weight=6),
    "toml": Format(seeds.csv, partial(a_log, ""), (".toml",), weight=6),
    "parquet": Format(seeds.parquet, partial(a_log, ""), (".parquet",), weight=4),
    "images": Format(seeds.images, partial(a_log, ""), ("camera", "run.toml", "sim.rig.toml"), weight=2),
    "rig": Format(seeds.rig, partial(a_rig, "r.rig.toml"), weight=3),
    "world": Format(seeds.world, partial(a_world, "hall.world.toml"), weight=4),
    "occupancy": Format(seeds.occupancy, partial(a_world, "w.world.toml"), weight=3),
    "points": Format(seeds.points, partial(a_world, "w.world.toml"), weight=3),
    "grid": Format(seeds.grid, partial(a_rig, "g.rig.toml"), weight=3),
    "simulation": Format(seeds.simulation, a_simulation, weight=2),
    "result": Format(seeds.result, a_result, ("run",), weight=3),
    "experiment": Format(seeds.experiment, an_experiment, ("e.toml",), weight=2),
    "store": Format(seeds.store, a_store, ("e.toml", "out"), weight=2),
    "tables": Format(foreign_seeds.tables, partial(a_log, "m.toml"), weight=4),
    "sllurp": Format(foreign_seeds.sllurp, partial(a_log, "m.toml")),
    "llrp": Format(foreign_seeds.llrp, partial(a_log, "m.toml")),
    "iot": Format(foreign_seeds.iot, partial(a_log, "m.toml")),
    "ros1": Format(foreign_seeds.ros1, partial(a_log, "run.toml"), ("sim.bag", "run.toml")),
    "sqlite": Format(foreign_seeds.sqlite, partial(a_log, "run.toml"), ("sim.db3", "run.toml")),
    "mcap": Format(foreign_seeds.mcap, partial(a_log, "run.toml"), ("sim.mcap", "run.toml")),
    "poses": Format(foreign_seeds.poses, a_score),
    "mrclam": Format(foreign_seeds.mrclam, partial(a_log, "", reader="mrclam", robot=1)),
    "plaza": Format(foreign_seeds.plaza, partial(a_log, "p.mat", reader="plaza", run=1)),
    "woods": Format(foreign_seeds.woods, partial(a_log, "w.mat", reader="utias_woods")),
    "sevenscenes": Format(foreign_seeds.sevenscenes, partial(a_log, "", reader="sevenscenes")),
    "rf_robot": Format(foreign_seeds.rf_robot, partial(a_log, "", reader="rf_robot", run=4)),
}


class Inputs:
    """The seeds of formats, made once below ``root``, and the folder for cases."""

    def __init__(self, root: Path, scratch: Path) -> None:
        self._root, self._scratch = root, scratch
        self._kept: dict[str, dict[str, bytes]] = {}

    def files(self, name: str) -> dict[str, bytes]:
        """The seed of a format."""
        if name not in self._kept:
            folder = self._root / name
            if not folder.is_dir():
                made = self._scratch.with_name(f"{self._scratch.name}-{name}")
                shutil.rmtree(made, ignore_errors=True)
                made.mkdir(parents=True)
                FORMATS[name].make(made)
                try:
                    made.rename(folder)
                except OSError:  # another process was faster
                    shutil.rmtree(made)
            from fuzzing.damage import read  # noqa: PLC0415

            self._kept[name] = read(folder)
        return self._kept[name]


def quietly(call: Callable[[], None]) -> None:
    """Suppress numpy's warnings about absurd numbers."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        call()
