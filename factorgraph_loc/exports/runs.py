"""Reads results of runs from the folders that ``fgloc run``, ``fgloc compare`` and ``fgloc experiment`` write."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import polars as pl
from pydantic import Field

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import DATA, foreign, read_bytes
from factorgraph_loc.files.models import FileModel, parse_model, read_json, read_toml
from factorgraph_loc.files.tables import read_parquet
from factorgraph_loc.io import results
from factorgraph_loc.model.belief import LearntPoint
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factors.se2 import Array

STORE = "store"  # the folder of the runs of a comparison or an experiment
COMPLETE = results.FILES[-1]  # the file that is written last, so that its presence marks a complete run
MARGIN = 60.0  # s: maximum time of an estimate before the start or after the end of its log


class _Landmark(FileModel, extra="ignore"):
    x: float | None
    y: float | None
    covariance: tuple[float | None, float | None, float | None]


class _Learnt(FileModel, extra="ignore"):
    """The landmarks in ``learnt.json``, the file of estimates other than poses. Other values in it are not read."""

    landmarks: dict[str, _Landmark]


class RunFolder(FileModel, extra="ignore"):
    """The folder ``path`` of a stored run, with the log, estimator, sensors and seed in its file ``config.toml``."""

    path: Path
    log: Annotated[str, Field(min_length=1)]
    estimator: Annotated[str, Field(min_length=1)]
    sensors: tuple[str, ...] | None = None
    seed: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True)
class StoredRun:
    """The estimates of one stored run of an estimator. Times are in seconds from the start of its log.

    ``causal``: estimates from the first localization on, each from earlier measurements only. ``final``: the trajectory
    estimated from the whole log. Both may be empty. ``series``: times (K,) and values (K,) by name: ``error_position``
    [m], ``error_heading`` [rad], ``nees``. ``landmarks``: estimated landmarks by name. ``events``: times [s] and texts.
    """

    name: str
    folder: RunFolder
    causal: Trajectory
    final: Trajectory
    series: dict[str, tuple[Array, Array]]
    landmarks: dict[str, LearntPoint]
    events: tuple[tuple[float, str], ...]

    def played(self) -> Trajectory:
        """Return the trajectory to animate: causal estimates, or the final trajectory if there are no causal estimates."""
        return self.causal if len(self.causal) else self.final


def is_results(path: Path) -> bool:
    """True if ``path`` is a result folder of a run, a comparison or an experiment."""
    return (path / COMPLETE).is_file() or ((path / results.INDEX).is_file() and (path / STORE).is_dir())


def find_runs(path: Path) -> list[RunFolder]:
    """Return the folders of the successful runs in a result folder, each with its log, estimator and seed.

    ``path``: the folder of one run, a comparison or an experiment. Raises InputError if it has no results.
    """
    folders = [path] if (path / COMPLETE).is_file() else _stored(path) if is_results(path) else []
    if not folders:
        raise InputError(f"{path}: contains no results, expected a folder that `fgloc run` or `fgloc compare` wrote")
    return [
        parse_model(RunFolder, read_toml(folder / results.CONFIG) | {"path": folder}, folder / results.CONFIG)
        for folder in folders
    ]


def _stored(path: Path) -> list[Path]:
    """Return the folders of the successful runs of a comparison or an experiment."""
    table = read_parquet(path / results.INDEX)
    with foreign(path / results.INDEX, "is no table of runs"):
        keys = table.filter(pl.col("status") == "ok")["key"].cast(pl.String).unique(maintain_order=True)
    return [path / STORE / key[:2] / key for key in keys]


def read_runs(folders: Sequence[RunFolder], log: Log) -> list[StoredRun]:
    """Return the estimates in the given folders of runs on ``log``.

    Each run gets a unique name: the estimator, with the seed and the folder appended if needed. Raises InputError if a
    run is of another log, or if a file is damaged.
    """
    names = [folder.estimator for folder in folders]
    with_seeds = [f"{folder.estimator}-seed{folder.seed}" for folder in folders]
    if len(set(names)) < len(names):
        names = with_seeds
    if len(set(names)) < len(names):
        names = [f"{name}-{folder.path.name}" for name, folder in zip(with_seeds, folders, strict=True)]
    if len(set(names)) < len(names):
        raise InputError(f"{folders[0].path}: a run is given twice, expected different runs")
    return [_read(folder, name, log) for folder, name in zip(folders, names, strict=True)]


def _read(folder: RunFolder, name: str, log: Log) -> StoredRun:
    if folder.log != log.name:
        raise InputError(f"{folder.path}: is a run on the log {folder.log}, expected a run on the log {log.name}")
    files = results.ResultFiles(lambda file: read_bytes(folder.path / file, DATA), log.t0_ns, folder.path)
    causal, final = (
        estimates.rows(np.asarray(np.isfinite(estimates.trajectory.poses).all(axis=1)))
        for estimates in files.estimates().values()
    )
    played = causal if len(causal.trajectory) else final
    known = {key: np.isfinite(values) for key, values in played.errors.items()}
    run = StoredRun(
        name,
        folder,
        causal.trajectory,
        final.trajectory,
        {key: (played.trajectory.t[known[key]], values[known[key]]) for key, values in played.errors.items()},
        _landmarks(folder.path / results.LEARNT),
        files.events(),
    )
    _check_times(run, log)
    return run


def _check_times(run: StoredRun, log: Log) -> None:
    """Raise InputError if an estimate is more than :data:`MARGIN` outside of the time span of ``log``."""
    first, last = log.span()
    for trajectory in (run.causal, run.final):
        if len(trajectory) and (trajectory.t[0] < first - MARGIN or trajectory.t[-1] > last + MARGIN):
            raise InputError(
                f"{run.folder.path}: has estimates from {trajectory.t[0]:.1f} s to {trajectory.t[-1]:.1f} s of the log's time, "
                f"expected times from {first:.1f} s to {last:.1f} s: is it a run of another log named {log.name}?"
            )


def _landmarks(path: Path) -> dict[str, LearntPoint]:
    points = {}
    for name, entry in parse_model(_Learnt, read_json(path), path).landmarks.items():
        xx, xy, yy = (np.nan if value is None else value for value in entry.covariance)
        points[name] = LearntPoint(np.array((entry.x, entry.y), dtype=float), np.array(((xx, xy), (xy, yy))))
    return points
