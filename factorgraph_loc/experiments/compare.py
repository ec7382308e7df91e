"""Comparison of several estimators on several logs. It is an experiment that is not described in a file."""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from pydantic import BaseModel

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.figures import Track
from factorgraph_loc.evaluation.inference import DIFFERENCES, differences
from factorgraph_loc.evaluation.plots import plot_log, remove_plots
from factorgraph_loc.evaluation.scores import REPORT
from factorgraph_loc.evaluation.tables import BASELINE, comparison_cells, further_tables, markdown, unscored, verdict
from factorgraph_loc.experiments.experiment import Done, Prepared, run_experiment
from factorgraph_loc.experiments.experiment_file import NO_TIME_LIMIT, Experiment
from factorgraph_loc.experiments.log_source import GivenSource
from factorgraph_loc.experiments.output import TABLES, write_tables
from factorgraph_loc.experiments.plan import PlannedRun, plan
from factorgraph_loc.experiments.reporting import PAGE, report_experiment
from factorgraph_loc.experiments.store import Store
from factorgraph_loc.files.models import parse_model
from factorgraph_loc.files.temporary import new_below, of_system, require_free, temporary_folder
from factorgraph_loc.io.readers import LogLike, RigLike, WorldLike, load_all
from factorgraph_loc.io.results import FILES, ResultFiles
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.scoring import MAX_GAP, TICK_GAP, Alignment
from factorgraph_loc.text import listed, plain

WRITTEN = (*TABLES, PAGE)
FINISHED = (*WRITTEN, *FILES)  # names of files of results, which are replaced only with ``overwrite``


@dataclass(frozen=True, repr=False)
class Comparison(Done):
    """The results of a comparison of estimators. ``out``: the folder of the results. ``repr`` returns the table as
    text."""

    out: Path

    def __repr__(self) -> str:
        return summary_text(self.rows)


def summary_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of a comparison as text, followed by sentences. The sentences are about missing scores, the best
    estimator and failed runs. ``rows``: the runs as dictionaries."""
    best = verdict(rows) if len({row["estimator"] for row in rows}) > 1 else []
    failures = [f"failed: {row['log']}, {row['estimator']}: {row['reason']}" for row in rows if row["status"] != "ok"]
    return "\n".join((markdown(*comparison_cells(rows)), *unscored(rows), *best, *failures))


def compare(
    logs: LogLike | Sequence[LogLike],
    estimators: Sequence[str],
    out: str | Path | None = None,
    *,
    settings: Mapping[str, Mapping[str, Any]] | None = None,
    sensors: Sequence[str] | None = None,
    prior: str | None = None,
    seeds: Iterable[int] = (0,),
    rig: RigLike | None = None,
    world: WorldLike | None = None,
    max_gap: float = MAX_GAP,
    tick_gap: float = TICK_GAP,
    align: Alignment = "none",
    rpe: bool = False,
    jobs: int | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Comparison:
    """Run several estimators on several logs with each seed, and return a comparison of their errors.

    ``out``: folder for the results, None for a new folder in ``out/``. ``overwrite``: whether existing results in
    ``out`` may be replaced. ``settings``: {estimator: {key: value}}. ``rig``, ``world``: sensors and map to use instead
    of those of the logs. ``sensors``: names of the sensors to use, None for all of the rig. ``prior``: the start pose,
    such as "log", "reference" or "unknown". ``max_gap`` [s]: scores exclude longer gaps between estimates. ``tick_gap``
    [s]: there are no estimates in longer gaps between measurements. ``align``: for additional scores after this
    alignment, such as "se2". ``rpe``: whether to report relative pose errors. ``jobs``: number of processes, None for
    one per core. ``progress``: called with the numbers of finished and all runs.

    A failed run does not stop the others, and the table states the reason. Runs with stored results are not repeated.
    The files in ``out`` are:

    - ``results.parquet``, ``results.csv``: a row for each run. ``table.md``: the table of the comparison.
    - ``differences.csv``: see :func:`~factorgraph_loc.evaluation.inference.differences`. ``plots``: folder of PNG
      files.
    - ``report.html``: see :func:`~factorgraph_loc.evaluation.report.write_report`.
    - ``store``: folder with the files of each run, see :class:`~factorgraph_loc.experiments.store.Store`.

    Raises InputError before any run if the input is invalid, or ``out`` contains results and ``overwrite`` is not set.
    """
    out = new_below(Path("out"), "compare") if out is None else Path(out)
    require_free(out, FINISHED, overwrite=overwrite)
    named = _named(estimators, settings or {})
    logs = load_all(logs, rig, world)
    if not logs or not named:
        raise InputError("there is nothing to compare, expected at least one log and one estimator")
    keys = {"prior": prior, "seeds": tuple(seeds), "max_gap": max_gap, "tick_gap": tick_gap, "align": align}
    several = (None if sensors is None else tuple(sensors),)
    experiment = _experiment(logs, named, keys | {"sensors": several}, rpe=rpe)
    prepared = _prepared(experiment, logs, out)
    for name in WRITTEN:
        (out / name).unlink(missing_ok=True)
    remove_plots(out / "plots")
    done = run_experiment(prepared, jobs=jobs, again=True, progress=lambda made, total, _: progress(made, total))
    report_experiment(experiment, prepared)
    _plot(logs, prepared, out / "plots")
    compared = pl.DataFrame(differences(done.rows), schema=DIFFERENCES)
    write_tables(done.table, compared, _table(done.rows, rpe=rpe), out)
    return Comparison(done.table, done.failures, done.warnings, out)


def _named(estimators: Sequence[str], settings: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Mapping[str, Any]]:
    """Return the settings of each of ``estimators`` by name. Raises InputError for settings of another estimator."""
    if unknown := [name for name in settings if name not in estimators]:
        raise InputError(f"settings are given for {unknown[0]}, which is not run here, expected {listed(estimators)}")
    return {name: settings.get(name, {}) for name in estimators}


def _experiment(
    logs: Sequence[Log], estimators: Mapping[str, Mapping[str, Any]], keys: Mapping[str, Any], *, rpe: bool
) -> Experiment:
    """Return the comparison as an experiment. ``estimators``: {name: settings}. ``keys``: values of further fields of
    :class:`Experiment`. ``rpe``: whether to report relative errors."""
    tables = further_tables([{"scoring.align": keys["align"]}] if keys["align"] != "none" else [], rpe=rpe)
    further = [key for keys in tables.values() for key in keys]
    content: dict[str, Any] = {
        "name": "Comparison",
        "logs": [plain(log.name) for log in logs],
        "estimators": [{"name": name, "settings": dict(settings)} for name, settings in estimators.items()],
        "report": {"metrics": [*REPORT, *further]} | ({"baseline": BASELINE} if BASELINE in estimators else {}),
        "limits": {"time": NO_TIME_LIMIT},
        **keys,
    }
    return parse_model(Experiment, content, "the comparison")


def _prepared(experiment: Experiment, logs: Sequence[Log], out: Path) -> Prepared[PlannedRun]:
    """Return the planned runs of the experiment, with the states of their stored results in ``out``."""
    with temporary_folder(of_system("plan")) as folder:  # nothing is written into ``out`` if the input is wrong
        runs = plan(experiment, folder, folder, given=[GivenSource(log, digest_of_log(log)) for log in logs])
    Store(out).create()
    return Prepared.of(out, runs, experiment.limits)


def digest_of_log(log: Log) -> str:
    """Return the sha256 of a log in memory. For the files that it names, size and modification time are included."""
    total = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, np.ndarray) and value.dtype != object:
            total.update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
        elif isinstance(value, BaseModel):
            add(dict(value))
        elif is_dataclass(value):
            add({column.name: getattr(value, column.name) for column in fields(value)})
        elif isinstance(value, Mapping):
            add(list(value.items()))
        elif isinstance(value, list | tuple | np.ndarray):
            total.update(f"{len(value)} ".encode())
            for item in value:
                add(item)
        else:
            stat = value.stat() if isinstance(value, Path) and value.exists() else None
            total.update(repr((value, stat and (stat.st_size, stat.st_mtime_ns))).encode())

    add(log)
    return total.hexdigest()


def _plot(logs: Sequence[Log], prepared: Prepared[PlannedRun], folder: Path) -> None:
    """Write the plots of each log into ``folder``. They show the first successful seed of each estimator."""
    store = prepared.store
    for log in logs:
        tracks: dict[str, Track] = {}
        for run in prepared.runs:
            if run.log == log.name and run.label not in tracks and store.state(run.key) == "ok":
                tracks[run.label] = Track.read(ResultFiles(partial(store.read, run.key), log.t0_ns), run.max_gap)
        if tracks:
            plot_log(log, tracks, folder)


def _table(rows: Sequence[Mapping[str, Any]], *, rpe: bool) -> str:
    """Return the content of ``table.md``. It has the table of the comparison, and the tables of
    :func:`further_tables`."""
    text = markdown(*comparison_cells(rows))
    for title, columns in further_tables(rows, rpe=rpe).items():
        text += f"\n{title}\n\n{markdown(*comparison_cells(rows, columns))}"
    return text
