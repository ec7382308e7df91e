"""An experiment from its file to the table of its results; stored runs are not repeated."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.warned import lines
from factorgraph_loc.experiments.execute import Executor, execute
from factorgraph_loc.experiments.experiment_file import Experiment, read_experiment
from factorgraph_loc.experiments.plan import MOST_RUNS, PlannedRun, TooManyRunsError, plan
from factorgraph_loc.experiments.pool import Processes
from factorgraph_loc.experiments.store import State, Store
from factorgraph_loc.files.bounded import kind
from factorgraph_loc.text import plain

if TYPE_CHECKING:
    import polars as pl

PACE = 20.0  # assumed ratio of log time to computing time, for an unknown estimator


@dataclass(frozen=True)
class Prepared:
    """An experiment with planned ``runs``; its results go to ``folder``, and ``states`` are those of the stored
    results by key.
    """

    experiment: Experiment
    folder: Path
    runs: list[PlannedRun]
    states: dict[str, State]

    @classmethod
    def of(cls, experiment: Experiment, folder: Path, runs: list[PlannedRun], *, verify: bool = False) -> Prepared:
        """The same with the states of stored results; ``verify``: check all checksums."""
        store = Store(folder)
        keys = dict.fromkeys(run.key for run in runs)
        return cls(experiment, folder, runs, {key: store.state(key, thorough=verify) for key in keys})

    @property
    def store(self) -> Store:
        """The store of the results."""
        return Store(self.folder)

    def damaged(self) -> list[PlannedRun]:
        """The runs with damaged results."""
        return [run for run in self.runs if self.states[run.key] == "damaged"]

    def todo(self, *, again: bool = False) -> list[PlannedRun]:
        """The runs to be made; with ``again`` also the failed ones."""
        done = ("ok",) if again else ("ok", "failed")
        return [run for run in self.runs if self.states[run.key] not in done]


@dataclass(frozen=True)
class Done:
    """The results: a row per run, see :func:`~factorgraph_loc.experiments.result_table.load_results`; a line for each failure, and
    each warning once."""

    rows: pl.DataFrame
    failures: list[str]
    warnings: list[str]


def prepare(
    file: str | Path,
    changes: Mapping[str, Any] | None = None,
    *,
    data_root: str | Path | None = None,
    out: str | Path | None = None,
    verify: bool = False,
    most: int = MOST_RUNS,
) -> Prepared:
    """Plan the experiment of a ``file`` with ``changes``, and look up stored results.

    ``changes``: values by dotted key, see :func:`~factorgraph_loc.experiments.experiment_file.read_experiment`. ``out``: folder of
    the results, by default the file's. ``verify``: check all checksums.

    Raises InputError for errors in the file, TooManyRunsError for more than ``most`` runs, StoreError if the folder for results
    cannot be written.
    """
    file = Path(file)
    experiment = read_experiment(file, changes)
    folder = experiment.folder() if out is None else Path(out)
    if (found := kind(folder)) not in ("", "a folder"):
        raise InputError(f"{folder}: is {found}, expected a folder for the results")
    store = Store(folder)
    store.create()
    try:
        runs = plan(experiment, file.parent, store.folder, None if data_root is None else str(data_root), most=most)
    except TooManyRunsError as error:
        raise TooManyRunsError(f"{plain(file)}: {error}") from error
    return Prepared.of(experiment, folder, runs, verify=verify)


def run_experiment(
    prepared: Prepared,
    *,
    jobs: int | None = None,
    again: bool = False,
    executor: Executor | None = None,
    progress: Callable[[int, int, int], None] = lambda _done, _total, _failed: None,
) -> Done:
    """Make the runs that are not stored, with ``again`` also the failed ones, and write the table of all results.

    ``jobs``: processes, by default one per core; ``executor``: computes the runs instead. ``progress`` is called
    with the numbers of runs made, to be made, and failed. The table is written also after an error or interrupt. Raises StoreError
    if the store cannot be written.
    """
    todo = prepared.todo(again=again)
    states = dict(prepared.states)
    waiting = {run.key for run in todo}
    failed = sum(states[run.key] == "failed" and run.key not in waiting for run in prepared.runs)
    made = 0
    progress(made, len(todo), failed)
    if executor is None:
        executor = Processes(max(1, min(jobs or os.cpu_count() or 1, len(todo))), prepared.experiment.limits)
    try:
        for outcome in execute(todo, prepared.folder, executor, again=again) if todo else ():
            states[outcome.key] = outcome.status
            made, failed = made + 1, failed + (outcome.status == "failed")
            progress(made, len(todo), failed)
    finally:
        for run in todo:  # an interrupt may come between a run's end and its outcome
            if states[run.key] not in ("ok", "failed"):
                states[run.key] = prepared.store.state(run.key, thorough=True)
        finished = [run for run in prepared.runs if states[run.key] in ("ok", "failed")]
        rows = _write_rows(finished, prepared)
    found = rows.to_dicts()
    failures = [
        f"{run.shown}: {row['reason']}" for run, row in zip(finished, found, strict=True) if row["status"] == "failed"
    ]
    return Done(rows, failures, lines(found))


def estimate_seconds(runs: Sequence[PlannedRun], folder: Path) -> float:
    """Estimated sum of the run times [s], from stored runs of the same label and the duration of the log, else a default."""
    from factorgraph_loc.experiments.result_table import load_results  # noqa: PLC0415

    paces: dict[str, list[float]] = {}
    with suppress(InputError):  # there are no results yet
        for row in load_results(folder).to_dicts():
            if (seconds := row.get("timing.run_seconds")) is not None and row["duration"] > 0.0:
                paces.setdefault(row["label"], []).append(seconds / row["duration"])
    return sum(run.duration * median(paces.get(run.label, [1.0 / PACE])) for run in runs)


def _write_rows(runs: Sequence[PlannedRun], prepared: Prepared) -> pl.DataFrame:
    from factorgraph_loc.experiments.result_table import collect, write_index  # noqa: PLC0415

    rows = collect(runs, prepared.store)
    write_index(rows, prepared.folder)
    return rows
