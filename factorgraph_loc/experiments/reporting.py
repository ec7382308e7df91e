"""The table of all results of an experiment, with a row per run, and the report of an experiment."""

import io
import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.report import RunFiles, Scene, write_report
from factorgraph_loc.evaluation.warned import WARNINGS
from factorgraph_loc.experiments.experiment import Prepared
from factorgraph_loc.experiments.keys import code_version, library_versions
from factorgraph_loc.experiments.plan import PlannedRun
from factorgraph_loc.experiments.store import Store, StoreError
from factorgraph_loc.files.bounded import kind
from factorgraph_loc.files.models import replacing
from factorgraph_loc.files.tables import read_parquet
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.version import __version__

INDEX = "results.parquet"
SWEEP = "sweep."
TEXTS = {"label", "log", "estimator", "sensors", "prior", "status", "kind", "reason", "key", WARNINGS}
PAGE = "report.html"


def collect(runs: Iterable[PlannedRun], store: Store) -> pl.DataFrame:
    """The rows of those runs whose results are stored; see :func:`load_results`. Raises DamagedError for a damaged one."""
    rows = [_row(run, store.row(run.key)) for run in runs]
    keys = dict.fromkeys(key for row in rows for key in row) or dict.fromkeys(sorted(TEXTS))
    table = pl.DataFrame(rows, schema=list(keys), infer_schema_length=None)
    nothing = {
        name: pl.String if name in TEXTS else pl.Float64 for name, kind in table.schema.items() if kind == pl.Null
    }
    return table.cast(nothing)  # type: ignore[arg-type]


def write_index(table: pl.DataFrame, folder: Path) -> None:
    """Write the table into ``folder``, atomically. Raises StoreError if it cannot be written."""
    content = io.BytesIO()  # polars reports a full disk as a file out of specification
    table.write_parquet(content)
    try:
        with replacing(folder / INDEX) as temporary:
            temporary.write_bytes(content.getvalue())
    except OSError as error:
        raise StoreError(f"{folder / INDEX}: cannot be written: {error.strerror or error}") from error


def load_results(path: str | Path) -> pl.DataFrame:
    """Load the results of an experiment from the folder ``path``, with a row per run.

    Columns: ``label``, ``log``, ``estimator``, ``sensors`` (comma-separated; null for those of the rig), ``prior``, ``seed``,
    ``sweep.KEY`` of each swept setting (null if it does not apply to the run), ``status`` (ok, failed), ``kind`` (error, timeout,
    memory, killed, vanished) and ``reason`` of a failure, ``key`` in the store, ``duration`` [s] of the log, ``warnings`` (one
    per line), and the scores of :func:`~factorgraph_loc.evaluation.metrics.score` (null in failed runs). Raises InputError if
    there are no results.
    """
    file = Path(path) / INDEX if kind(Path(path)) == "a folder" else Path(path)
    try:
        return read_parquet(file)
    except InputError as error:
        raise InputError(f"{error}; `fgloc experiment run` writes it anew") from error


def _row(run: PlannedRun, found: dict[str, Any]) -> dict[str, Any]:
    row = {
        "label": run.label,
        "log": run.log,
        "estimator": run.estimator,
        "sensors": None if run.sensors is None else ",".join(run.sensors),
        "prior": run.prior,
        "seed": run.seed,
        **{f"{SWEEP}{key}": value for key, value in run.sweep.items()},
        **{name: found.pop(name) for name in ("status", "kind", "reason")},
        "key": run.key,
        "duration": run.duration,
    }
    return row | {name: value for name, value in found.items() if name not in row}


@dataclass(frozen=True)
class Report:
    """The ``page`` that was written, and descriptions of the ``damaged`` runs that it excludes."""

    page: Path
    damaged: list[str]


def report_experiment(prepared: Prepared, out: Path | None = None) -> Report:
    """Write the report of all existing results of an experiment, by default into its folder.

    All results are compared with their checksums; damaged ones are named and excluded. Scenes of the logs are kept in the store.
    Raises InputError without any results, or if the page cannot be written.
    """
    prepared = prepared.verified()
    damaged = [run.shown for run in prepared.damaged()]
    rows = collect((run for run in prepared.runs if prepared.states[run.key] in ("ok", "failed")), prepared.store)
    runs = {run.key: run for run in prepared.runs}
    scenes: dict[str, Scene | None] = {}

    def files(key: str) -> RunFiles:
        run = runs[key]
        if run.log_digest not in scenes:
            scenes[run.log_digest] = _scene(run, prepared.store.folder / "scenes" / f"{run.log_digest}.json")
        return RunFiles(partial(prepared.store.read, key), scenes[run.log_digest])

    path = out or prepared.folder / PAGE
    settings = prepared.experiment.report
    is_there = settings.baseline in (rows["label"].to_list() if len(rows) else ())
    with writing(path):
        write_report(
            rows,
            files,
            path,
            metrics=settings.metrics,
            baseline=settings.baseline if is_there else None,  # the baseline may be missing from partial results
            title=prepared.experiment.name,
            experiment=json.loads(prepared.experiment.model_dump_json(exclude_unset=True)),
            damaged=damaged,
            versions={"factorgraph-loc": __version__, "its source, sha256": code_version(), **library_versions()},
        )
    return Report(path, damaged)


def _scene(run: PlannedRun, kept: Path) -> Scene | None:
    """The scene of a run's log; None if the log has disappeared."""
    with suppress(OSError, ValueError):
        return Scene.read(kept)
    try:
        scene = Scene.of(run.source.load())
    except InputError:
        return None
    with suppress(OSError):  # results may be read-only
        kept.parent.mkdir(parents=True, exist_ok=True)
        scene.write(kept)
    return scene
