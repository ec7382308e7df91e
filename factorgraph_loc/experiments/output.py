"""Writing of the files of a run (trajectories, estimates, learnt values, events, scores, configuration) and of tables of runs.

Except for times, all files of a run are reproducible to the byte.
"""

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import polars as pl

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.metrics import errors, score
from factorgraph_loc.experiments.store import TIMING, TIMINGS
from factorgraph_loc.files.columns import COVARIANCES
from factorgraph_loc.files.models import write_text, write_toml
from factorgraph_loc.files.tables import write_parquet
from factorgraph_loc.files.temporary import of_system, require_free, sweep, temporary_folder, writing
from factorgraph_loc.io.native.world_file import write_world
from factorgraph_loc.io.results import (
    CAUSAL,
    CONFIG,
    ESTIMATES,
    EVENTS,
    FILES,
    FINAL,
    INNOVATIONS,
    LEARNT,
    METRICS,
)
from factorgraph_loc.model.belief import Learnt
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.scoring import Alignment
from factorgraph_loc.model.trajectory import Trajectory, write_tum
from factorgraph_loc.model.world import World
from factorgraph_loc.text import json_text, plain_lines, quoted
from factors.se2 import Array

MAP = "map.world.toml"
TABLES = ("results.csv", "differences.csv", "table.md")


def write_run(
    result: RunResult, log: Log, out: Path, *, align: Alignment = "none", overwrite: bool = False
) -> dict[str, Any]:
    """Score a run, write its files into the folder ``out``, and return {key: score}.

    ``align``: alignment for additional scores, such as "se2". The files are written to a temporary folder first. Other
    files in ``out`` are not changed. Raises InputError if ``out`` contains results and ``overwrite`` is not set. Files:

    - ``final.tum``, ``causal.tum``: trajectories. The latter starts when the robot is localized first.
    - ``estimates.parquet``: a row for each tick (time of an estimate, every 0.1 s) and ``kind`` of trajectory (causal,
      final). ``t_ns``: timestamp. ``x``, ``y`` [m], ``heading`` [rad], and covariances, in the world frame.
      ``error_position`` [m], ``error_heading`` [rad, absolute], ``nees``: compared with the reference pose that is
      nearest in time, null if this pose is nearer to another tick. ``update_ms``: the slowest update since the previous
      tick, null without an update. ``status``, ``doubts_model`` (True if measurements contradict the model of their
      sensor): those of the causal estimate, also in rows of the final trajectory.
    - ``learnt.json``: ``constants`` by name with ``value`` and ``sigma``; ``landmarks`` by name with ``x``, ``y`` [m]
      and ``covariance`` (xx, xy, yy) [m^2] in the world frame.
    - ``events.csv``: the timestamp ``t_ns``, the time ``t`` [s] since the log's start, and the event.
    - ``innovations.parquet``: for each update the ``sensor``, the timestamp ``t_ns``, the normalised innovation squared
      ``nis`` and its degrees of freedom ``dof``.
    - ``metrics.json``: the scores. ``config.toml``: the configuration of the run.
    - ``map.world.toml`` and a file of points: the map with the points that the run estimated, if it estimated any.
    """
    require_free(out, FILES, overwrite=overwrite)
    scores = score(result, log, align)
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(out) as temporary:
            content = temporary / "run"  # unlike the temporary folder, it has the usual permissions of a new folder
            content.mkdir()
            write_files(result, log, scores, content)
            if (world := map_of(result, log)) is not None:
                write_world(world, content / MAP)
            if out.exists():
                remove_run(out)
                for path in sorted(content.iterdir(), key=lambda path: path.name == FILES[-1]):
                    path.replace(out / path.name)
            else:
                content.replace(out)
    return scores


def save_run(
    result: RunResult, log: Log, out: Path, *, align: Alignment = "none", overwrite: bool = False
) -> dict[str, Any]:
    """Write the files of a run into the folder ``out``, and return {key: score}. If that fails, write them to a new
    temporary folder instead, and raise an InputError that names it. ``align``: alignment for additional scores, such as
    "se2". ``overwrite``: whether existing results may be replaced."""
    try:
        return write_run(result, log, out, align=align, overwrite=overwrite)
    except InputError as error:
        folder = _keep(result, log, align)
        if folder is None:
            raise
        raise InputError(f"{error}; the results are in {folder}") from error


def _keep(result: RunResult, log: Log, align: Alignment) -> Path | None:
    """Write the files of a run to a new temporary folder of the system. Return the folder, or None on failure."""
    folder = None
    try:
        folder = Path(tempfile.mkdtemp(prefix="fgloc-run-"))
        write_run(result, log, folder, align=align)
    except (InputError, OSError):
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
        return None
    return folder


def write_files(result: RunResult, log: Log, scores: Mapping[str, Any], folder: Path) -> None:
    """Write the files of a run, except for a map, into an empty ``folder``. ``scores``: {key: value}. The files are
    described in :func:`write_run`."""
    causal = result.causal() or Trajectory(np.empty(0), np.empty((0, 3)))
    write_tum(result.final, folder / FINAL, log.t0_ns)
    write_tum(causal, folder / CAUSAL, log.t0_ns)
    write_parquet(estimates(result, log), folder / ESTIMATES)
    write_toml(folder / CONFIG, result.config)
    write_text(folder / LEARNT, json_text(learnt_tables(result.learnt)))
    write_parquet(innovations(result, log), folder / INNOVATIONS)
    write_text(folder / EVENTS, events(result, log).write_csv())
    write_text(folder / METRICS, json_text(scores))


def map_of(result: RunResult, log: Log) -> World | None:
    """Return the log's map with the points in space that a run estimated, or None if the run estimated no points.

    The estimated points replace the points of the map, or are added to them if the run extended the map.
    """
    points, known = result.learnt.points, log.world.points
    if points is None or not len(points):
        return None
    if known is not None and result.config["settings"].get("landmarks") == "extended":
        from factorgraph_loc.mapping.point_maps import merged  # noqa: PLC0415 - imports scipy.spatial, which other runs do not need

        points, _ = merged(known, points)
    return log.world.model_copy(update={"name": f"{log.name}-map", "points": points})


def with_ending(out: Path, suffix: str, ending: str, *, overwrite: bool) -> Path:
    """Return the path of a second file next to ``out``, with ``ending`` in place of the ``suffix`` of ``out``.

    Raises InputError if ``out`` has another suffix, its folder is missing, or either file exists without ``overwrite``.
    """
    name = out.name.removesuffix(suffix)
    if name in ("", out.name):
        raise InputError(f"--out is {quoted(str(out))}, expected a name that ends in {suffix}")
    if not out.parent.is_dir():
        raise InputError(f"--out is {quoted(str(out))}, but there is no folder {out.parent}")
    sweep(out.parent)
    neighbour = out.with_name(f"{name}{ending}")
    for path in (out, neighbour):
        if path.exists() and not overwrite:
            raise InputError(f"{path}: exists already; choose another name or give --overwrite")
    return neighbour


def remove_run(out: Path) -> None:
    """Remove the files of a previous run from a folder. The file that marks a complete run is removed first."""
    for name in (*reversed(FILES), *(path.name for path in out.glob(f"{MAP.partition('.')[0]}.*"))):
        (out / name).unlink(missing_ok=True)


def estimates(result: RunResult, log: Log) -> pl.DataFrame:
    """Return a table of poses, covariances and errors, with a row for each tick and ``kind`` of trajectory. The columns
    are described in :func:`write_run`."""
    flags = pl.DataFrame(
        {"status": list(result.status), "doubts_model": list(result.doubts_model) or [False] * len(result.status)},
        {"status": pl.String, "doubts_model": pl.Boolean},
    )
    causal = Trajectory(result.t, result.poses, result.covariances)
    at = np.searchsorted(result.t, result.final.t - 1e-9).clip(max=len(result.t) - 1)
    return pl.concat(
        [
            _rows("causal", causal, result.max_gap, log, _slowest_update(result), flags),
            _rows("final", result.final, result.max_gap, log, np.full(len(result.final), np.nan), flags[at]),
        ]
    )


def learnt_tables(learnt: Learnt) -> dict[str, Any]:
    """Return the estimated constants and landmarks as {"constants": {name: {...}}, "landmarks": {name: {...}}} for
    JSON. The inner keys are described in :func:`write_run`."""
    constants = {name: {"value": value, "sigma": sigma} for name, (value, sigma) in learnt.values.items()}
    landmarks = {}
    for name, point in learnt.landmarks.items():
        x, y = point.position.tolist()
        (xx, xy), (_, yy) = point.covariance.tolist()
        landmarks[name] = {"x": x, "y": y, "covariance": [xx, xy, yy]}
    return {"constants": constants, "landmarks": landmarks}


def events(result: RunResult, log: Log) -> pl.DataFrame:
    """Return a table of the events of a run. Columns: timestamp ``t_ns``, time ``t`` [s] since the log's start,
    ``event``."""
    rows = [(log.t0_ns + round(e.t * 1e9), e.t, str(e)) for e in result.diagnostics.events]
    return pl.DataFrame(rows, schema={"t_ns": pl.Int64, "t": pl.Float64, "event": pl.String}, orient="row")


def innovations(result: RunResult, log: Log) -> pl.DataFrame:
    """Return a table of the normalised innovation squared (NIS) of each update. The columns are ``sensor``, timestamp
    ``t_ns``, ``nis``, and its degrees of freedom ``dof``."""
    updates = sorted(result.diagnostics.nis.items())
    rows = [(sensor, log.t0_ns + round(t * 1e9), nis, dof) for sensor, rows in updates for t, nis, dof in rows]
    schema = {"sensor": pl.String, "t_ns": pl.Int64, "nis": pl.Float64, "dof": pl.Float64}
    return pl.DataFrame(rows, schema=schema, orient="row")


def _rows(
    kind: str,
    trajectory: Trajectory,
    max_gap: float,
    log: Log,
    update_ms: Array,
    flags: pl.DataFrame,
) -> pl.DataFrame:
    """Return the rows of ``estimates.parquet`` for one ``kind`` of trajectory, "causal" or "final". ``update_ms`` (N,):
    its column. ``flags``: its columns ``status`` and ``doubts_model``."""
    n = len(trajectory)
    covariances = trajectory.covariances if trajectory.covariances is not None else np.full((n, 3, 3), np.nan)
    position, heading, nees = np.full((3, n), np.nan)
    if log.reference is not None and n:
        e = errors(trajectory, log.reference, max_gap)
        rows = np.flatnonzero(np.isfinite(e.position))
        nearest = np.searchsorted((trajectory.t[1:] + trajectory.t[:-1]) / 2.0, e.t[rows])
        position[nearest], heading[nearest], nees[nearest] = e.position[rows], e.heading[rows], e.nees[rows]
    columns: dict[str, Any] = {
        "kind": [kind] * n,
        "t_ns": log.t0_ns + np.round(trajectory.t * 1e9).astype(np.int64),
        "x": trajectory.poses[:, 0],
        "y": trajectory.poses[:, 1],
        "heading": trajectory.poses[:, 2],
        **{name: covariances[:, i, j] for name, (i, j) in COVARIANCES.items()},
        "error_position": position,
        "error_heading": heading,
        "nees": nees,
        "update_ms": update_ms,
    }
    table = pl.DataFrame(columns, schema_overrides={"kind": pl.String, "t_ns": pl.Int64})
    return table.with_columns(pl.col(pl.Float64).fill_nan(None), *flags)


def _slowest_update(result: RunResult) -> Array:
    """Return for each tick (time of an estimate) the time [ms] of the slowest update since the previous tick, NaN
    without one."""
    slowest = np.full(len(result.t), np.nan)
    tick = np.searchsorted(result.t, result.timings.update_t)
    inside = tick < len(result.t)  # updates after the last tick are omitted
    np.fmax.at(slowest, tick[inside], result.timings.update_ms[inside])
    return slowest


def run_files(result: RunResult, log: Log, started: float, align: Alignment = "none") -> dict[str, bytes]:
    """Return the files of a run as {file name: content}, to be stored with an experiment.

    They are the files of :func:`write_run`. Computing times are in a separate file and ``update_ms`` is empty, so that
    all other files are reproducible. ``started`` [s]: value of ``perf_counter`` at the start of the run.
    """
    scores = score(result, log, align)
    timings = {name: value for name, value in scores.items() if name.startswith(TIMING)}
    untimed = replace(result, timings=replace(result.timings, update_t=np.empty(0), update_ms=np.empty(0)))
    with temporary_folder(of_system("run")) as folder:
        write_files(untimed, log, {k: v for k, v in scores.items() if k not in timings}, folder)
        files = {name: (folder / name).read_bytes() for name in FILES}
    return files | {TIMINGS: json_text(timings | {"timing.run_seconds": perf_counter() - started}).encode()}


def write_tables(table: pl.DataFrame, differences: pl.DataFrame, text: str, out: Path) -> None:
    """Write the runs (``table``), the ``differences`` of methods, and ``text`` (table.md) into the folder ``out``."""
    write_text(out / "results.csv", plain_lines(table.write_csv()))
    write_text(out / "differences.csv", plain_lines(differences.write_csv()))
    write_text(out / "table.md", plain_lines(text))
