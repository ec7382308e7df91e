"""Execution of an experiment: from its file to the table of its results. Runs with stored results are not repeated."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, Generic, TypeVar, get_args

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.warned import lines
from factorgraph_loc.experiments.cluster import Cluster
from factorgraph_loc.experiments.execute import Executor, Planned, Processes, execute
from factorgraph_loc.experiments.experiment_file import Experiment, Limits, read_experiment
from factorgraph_loc.experiments.plan import PlannedRun, plan
from factorgraph_loc.experiments.store import State, Store
from factorgraph_loc.files.bounded import kind

if TYPE_CHECKING:
    import polars as pl

STATES = get_args(State)
PACE = 20.0  # assumed ratio of a log's duration to the computing time, for estimators without stored runs
Run = TypeVar("Run", bound=Planned)


@dataclass(frozen=True)
class Prepared(Generic[Run]):
    """The planned runs of an experiment. ``folder``: folder of the results. ``limits``: time and memory of each run.

    ``states``: {key of a run: state of its stored results}, where the state is ok, failed, missing or damaged.
    """

    folder: Path
    runs: Sequence[Run]
    limits: Limits
    states: dict[str, State]

    @classmethod
    def of(cls, folder: Path, runs: Sequence[Run], limits: Limits) -> Prepared[Run]:
        """Return the runs with the states of their stored results, which are read from ``folder``."""
        store = Store(folder)
        return cls(folder, runs, limits, {key: store.state(key) for key in dict.fromkeys(run.key for run in runs)})

    @property
    def store(self) -> Store:
        """The store of the results."""
        return Store(self.folder)

    def damaged(self) -> list[Run]:
        """Return the runs with damaged results."""
        return [run for run in self.runs if self.states[run.key] == "damaged"]

    def todo(self, *, again: bool = False) -> list[Run]:
        """Return the runs without usable results, which are to be executed. ``again``: also return failed runs."""
        done = ("ok",) if again else ("ok", "failed")
        return [run for run in self.runs if self.states[run.key] not in done]


@dataclass(frozen=True)
class Done:
    """The results of several runs. ``warnings``: each distinct warning once. ``failures``: a text for each failed run.

    ``table``: a row for each run, see :func:`~factorgraph_loc.experiments.result_table.load_results`.
    """

    table: pl.DataFrame
    failures: list[str]
    warnings: list[str]

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The rows of ``table`` as dictionaries, all with the same keys."""
        return self.table.to_dicts()


@dataclass(frozen=True)
class ExperimentStatus:
    """The progress of an experiment. ``folder``: folder of its results.

    ``labels``: {label of an estimator: {state: number of runs}}, with the states ok, failed, missing and damaged.
    ``failures``: a row for each failed run, with its ``reason``. ``damaged``: descriptions of damaged runs.
    """

    folder: Path
    labels: Mapping[str, Mapping[str, int]]
    failures: Sequence[Mapping[str, Any]]
    damaged: Sequence[str]


def experiment(
    file: str | Path,
    *,
    changes: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    data_root: str | Path | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    retry_failed: bool = False,
    progress: Callable[[int, int, int], None] = lambda _done, _total, _failed: None,
) -> Done:
    """Execute the runs of an experiment file that have no stored results yet, and return the results of all runs.

    ``changes``: {dotted key: value} that replace values of the file. ``out``: folder of the results, None for the
    folder that the file names. ``data_root``: folder of the datasets, None for the environment variable FGLOC_DATA.
    ``jobs``: number of processes, None for one per core. ``scheduler``: address of the scheduler of a
    ``dask.distributed`` cluster, which then executes the runs. ``retry_failed``: whether to repeat failed runs. Damaged
    runs are always repeated. ``progress``: called with the numbers of finished, all and failed runs.

    A failed run raises no exception. It has a row in the table of results and an entry in ``failures``.
    """
    _, prepared = prepare(file, changes, out=out, data_root=data_root)
    return run_experiment(prepared, jobs=jobs, scheduler=scheduler, again=retry_failed, progress=progress)


def status(
    file: str | Path,
    *,
    changes: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    data_root: str | Path | None = None,
) -> ExperimentStatus:
    """Return how many runs of an experiment file are ok, failed, missing or damaged. ``changes``: {dotted key: value}
    that replace values of the file. ``out``: folder of the results, None for the folder that the file names.
    ``data_root``: folder of the datasets, None for the environment variable FGLOC_DATA."""
    _, planned = prepare(file, changes, out=out, data_root=data_root)
    counts = {run.label: dict.fromkeys(STATES, 0) for run in planned.runs}
    for run in planned.runs:
        counts[run.label][planned.states[run.key]] += 1
    failures = [
        {"log": run.log, "label": run.label, "seed": run.seed, **dict(run.sweep), **planned.store.row(run.key)}
        for run in planned.runs
        if planned.states[run.key] == "failed"
    ]
    return ExperimentStatus(planned.folder, counts, failures, [run.shown for run in planned.damaged()])


def prepare(
    file: str | Path,
    changes: Mapping[str, Any] | None = None,
    *,
    data_root: str | Path | None = None,
    out: str | Path | None = None,
) -> tuple[Experiment, Prepared[PlannedRun]]:
    """Return the content of an experiment file, and its planned runs with the states of their stored results.

    ``changes``: {dotted key: value} that replace values of the file, such as ``{"smoother.lag": 10}``. ``data_root``:
    folder of the datasets, None for the environment variable FGLOC_DATA. ``out``: folder of the results, None for the
    folder that the file names.

    Raises InputError for errors in the file and for too many runs, and StoreError if ``out`` cannot be written.
    """
    file = Path(file)
    experiment = read_experiment(file, changes)
    folder = Path(out or experiment.out or f"out/{experiment.name}")
    if (kind_of_path := kind(folder)) not in ("", "a folder"):
        raise InputError(f"{folder}: is {kind_of_path}, expected a folder for the results")
    store = Store(folder)
    store.create()
    runs = plan(experiment, file.parent, store.folder, None if data_root is None else str(data_root))
    return experiment, Prepared.of(folder, runs, experiment.limits)


def run_experiment(
    prepared: Prepared[Any],
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    again: bool = False,
    progress: Callable[[int, int, int], None] = lambda _done, _total, _failed: None,
) -> Done:
    """Execute the runs without stored results, write the table of all results, and return the results.

    ``jobs``: number of processes, None for one per core. ``scheduler``: address of the scheduler of a
    ``dask.distributed`` cluster, which then executes the runs. ``again``: whether to repeat failed runs. ``progress``:
    called with the numbers of finished, all and failed runs. The table is written also after an error or an interrupt.
    Raises StoreError if the store cannot be written.
    """
    from factorgraph_loc.experiments.result_table import collect, write_index  # noqa: PLC0415

    if scheduler is not None and jobs is not None:
        raise InputError("--jobs applies to this machine, but --scheduler names a cluster: remove one of them")
    todo = prepared.todo(again=again)
    states = dict(prepared.states)
    waiting = {run.key for run in todo}
    failed = sum(states[run.key] == "failed" and run.key not in waiting for run in prepared.runs)
    made = 0
    progress(made, len(todo), failed)
    executor: Executor
    if scheduler is None:
        executor = Processes(max(1, min(jobs or os.cpu_count() or 1, len(todo))), prepared.limits)
    else:
        executor = Cluster(scheduler, prepared.limits)
    try:
        for key, state in execute(todo, prepared.folder, executor, again=again) if todo else ():
            states[key] = state
            made, failed = made + 1, failed + (state == "failed")
            progress(made, len(todo), failed)
    finally:
        for run in todo:  # an interrupt may come after a run is stored and before its state is recorded
            if states[run.key] not in ("ok", "failed"):
                states[run.key] = prepared.store.state(run.key)
        finished = [run for run in prepared.runs if states[run.key] in ("ok", "failed")]
        rows = collect(finished, prepared.store)
        write_index(rows, prepared.folder)
    by_run = rows.to_dicts()
    failures = [
        f"{run.shown}: {row['reason']}" for run, row in zip(finished, by_run, strict=True) if row["status"] == "failed"
    ]
    return Done(rows, failures, lines(by_run))


def estimate_seconds(runs: Sequence[PlannedRun], folder: Path) -> float:
    """Return an estimate of the total computing time [s] of ``runs``, from the durations of their logs.

    ``folder``: folder of stored results. The computing time per second of log is that of stored runs with the same
    label. Without such runs it is :data:`PACE`.
    """
    from factorgraph_loc.experiments.result_table import load_results  # noqa: PLC0415

    paces: dict[str, list[float]] = {}
    with suppress(InputError):  # there are no results yet
        for row in load_results(folder).to_dicts():
            if (seconds := row.get("timing.run_seconds")) is not None and row["duration"] > 0.0:
                paces.setdefault(row["label"], []).append(seconds / row["duration"])
    return sum(run.duration * median(paces.get(run.label, [1.0 / PACE])) for run in runs)
