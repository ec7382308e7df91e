"""Writing of the report of an experiment as an HTML page."""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.report import Scene, write_report
from factorgraph_loc.experiments.experiment import Prepared, prepare
from factorgraph_loc.experiments.experiment_file import Experiment
from factorgraph_loc.experiments.keys import code_version, library_versions
from factorgraph_loc.experiments.plan import PlannedRun
from factorgraph_loc.experiments.result_table import collect
from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.io.results import ResultFiles
from factorgraph_loc.version import __version__

PAGE = "report.html"


@dataclass(frozen=True)
class Report:
    """A written report. ``page``: its path. ``damaged``: descriptions of damaged runs, which the report excludes."""

    page: Path
    damaged: list[str]


def report(
    file: str | Path,
    *,
    changes: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    data_root: str | Path | None = None,
) -> Report:
    """Write the results of an experiment as an HTML page into its folder. Damaged results are listed, but not used.

    ``file``: the experiment file. ``changes``: {dotted key: value} that replace values of the file. ``out``: folder of
    the results, None for the folder that the file names. ``data_root``: folder of the datasets, None for the
    environment variable FGLOC_DATA.
    """
    return report_experiment(*prepare(file, changes, out=out, data_root=data_root))


def report_experiment(experiment: Experiment, prepared: Prepared[PlannedRun]) -> Report:
    """Write the report of all existing results of an experiment into its folder.

    All results are compared with their checksums. Damaged results are listed and excluded. Maps and references of the
    logs are cached in the store. Raises InputError if there are no results, or if the page cannot be written.
    """
    prepared = Prepared.of(prepared.folder, prepared.runs, prepared.limits)
    damaged = [run.shown for run in prepared.damaged()]
    rows = collect((run for run in prepared.runs if prepared.states[run.key] in ("ok", "failed")), prepared.store)
    runs = {run.key: run for run in prepared.runs}
    scenes: dict[str, Scene | None] = {}

    def files(key: str) -> tuple[ResultFiles, Scene | None]:
        run = runs[key]
        if run.log_digest not in scenes:
            scenes[run.log_digest] = _scene(run, prepared.store.folder / "scenes" / f"{run.log_digest}.json")
        scene = scenes[run.log_digest]
        return ResultFiles(partial(prepared.store.read, key), None if scene is None else scene.t0_ns), scene

    path = prepared.folder / PAGE
    with writing(path):
        write_report(
            rows,
            files,
            path,
            metrics=experiment.report.metrics,
            baseline=experiment.report.baseline,
            title=experiment.name,
            experiment=json.loads(experiment.model_dump_json(exclude_unset=True)),
            damaged=damaged,
            versions={"factorgraph-loc": __version__, "its source, sha256": code_version(), **library_versions()},
        )
    return Report(path, damaged)


def _scene(run: PlannedRun, kept: Path) -> Scene | None:
    """Return the map and reference of a run's log. ``kept``: file that caches them. None if the log cannot be read."""
    with suppress(OSError, ValueError):
        return Scene.model_validate_json(kept.read_bytes())
    try:
        scene = Scene.of(run.source.load())
    except InputError:
        return None
    with suppress(OSError):  # the folder of the results may be read-only
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_text(kept, scene.model_dump_json())
    return scene
