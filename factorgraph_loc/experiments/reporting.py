"""The page of an experiment's results, from what is stored."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import polars as pl

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.report import RunFiles, Scene, write_report
from factorgraph_loc.experiments.experiment import Prepared
from factorgraph_loc.experiments.plan import PlannedRun

PAGE = "report.html"


def report_experiment(prepared: Prepared, rows: pl.DataFrame, out: Path | None = None) -> Path:
    """Write the page of an experiment with the results ``rows``, by default into its folder, and return its path.

    What the logs look like is kept in the store, so that they are read once. InputError without any results, or for damaged ones.
    """
    runs = {run.key: run for run in prepared.runs}
    scenes: dict[str, Scene | None] = {}

    def files(key: str) -> RunFiles:
        run = runs[key]
        if run.log_digest not in scenes:
            scenes[run.log_digest] = _scene(run, prepared.store.folder / "scenes" / f"{run.log_digest}.json")
        return RunFiles(partial(prepared.store.read, key), scenes[run.log_digest])

    path = out or prepared.folder / PAGE
    settings = prepared.experiment.report
    write_report(
        rows,
        files,
        path,
        metrics=settings.metrics,
        baseline=settings.baseline,
        title=prepared.experiment.name,
        experiment=json.loads(prepared.experiment.model_dump_json(exclude_unset=True)),
    )
    return path


def _scene(run: PlannedRun, kept: Path) -> Scene | None:
    """Of a run's log; None if the log has vanished."""
    try:
        return Scene.read(kept)
    except (OSError, ValueError, KeyError):
        pass
    try:
        scene = Scene.of(run.source.load())
    except InputError:
        return None
    kept.parent.mkdir(parents=True, exist_ok=True)
    scene.write(kept)
    return scene
