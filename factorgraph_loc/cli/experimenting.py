"""The commands ``fgloc experiment`` and ``fgloc active``.

``fgloc experiment`` executes many runs that a file describes, stores their results and writes a report. ``fgloc
active`` simulates robots that plan their paths so as to localize themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_loc.cli import completion, show
from factorgraph_loc.cli.options import (
    DataRoot,
    Jobs,
    Json,
    Out,
    Overwrite,
    Seeds,
    key_and_value,
    nested_changes,
    parse_list,
    takes_options,
)
from factorgraph_loc.model.scoring import parse_seeds
from factorgraph_loc.plugins import ACTIVE_ESTIMATORS, POLICIES

if TYPE_CHECKING:
    from factorgraph_loc.experiments.experiment import Done, Prepared


SHOWN = 10  # maximum number of failures, and of damaged results, that are printed

app = typer.Typer(no_args_is_help=True, help="Experiments: run them, show their status, report their results.")

File = Annotated[Path, typer.Argument(metavar="FILE", help="The experiment: a TOML file.")]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace the value of a key of FILE. LABEL.KEY sets an estimator, simulation.KEY simulated logs. May be repeated.",
    ),
]
OutFolder = Annotated[
    Path | None,
    typer.Option("--out", "-o", metavar="OUT", help="Folder for the results. Default: the folder that FILE names."),
]


@dataclass(frozen=True)
class ExperimentOptions:
    """The options that the commands of ``fgloc experiment`` share, except ``new``."""

    set_: Changes = None
    out: OutFolder = None
    data_root: DataRoot = None

    def given(self) -> dict[str, Any]:
        """Return the options as keyword arguments for the functions of ``experiments.experiment``."""
        changes = dict(key_and_value(text, "--set") for text in self.set_ or ())
        return {"changes": changes, "out": self.out, "data_root": self.data_root}


@app.command()
def new(file: File, overwrite: Overwrite = False, json: Json = False) -> None:
    """Write an example of an experiment file, with comments.

    Example: fgloc experiment new lags.toml
    """
    from factorgraph_loc.experiments.experiment_file import write_new

    write_new(file, overwrite=overwrite)
    if json:
        show.document({"file": str(file)})
    else:
        show.line(f"wrote {file}; `fgloc experiment run {file}` runs it")


@app.command()
@takes_options
def run(
    file: File,
    *,
    options: ExperimentOptions,
    jobs: Jobs = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Scheduler of a dask.distributed cluster that executes the runs."),
    ] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Run failed runs again.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List the runs and estimate their duration.")] = False,
    json: Json = False,
) -> None:
    """Execute the runs of an experiment that have no result yet. The same command resumes an interrupted experiment.

    Example: fgloc experiment run lags.toml
    """
    from factorgraph_loc.experiments.experiment import prepare, run_experiment

    experiment, prepared = prepare(file, **options.given())
    if dry_run:
        _print_plan(prepared, jobs, retry_failed, json)
        return
    try:
        show.first_use()
        with show.progress("runs", counted=True) as bar:
            done = run_experiment(
                prepared,
                jobs=jobs,
                scheduler=scheduler,
                again=retry_failed,
                progress=lambda done, total, failed: bar(done, total, f"{failed} failed" if failed else ""),
            )
    except KeyboardInterrupt as stop:
        stop.add_note(f"finished runs are kept in {prepared.folder}; the same command resumes")
        raise
    _print_done(done, prepared.folder, experiment.report.metrics, file, json)
    if done.failures:
        raise typer.Exit(1)


def _print_done(done: Done, folder: Path, metrics: Sequence[str], file: Path, json: bool) -> None:
    show.outcome(done.warnings, done.failures, SHOWN, f", see `fgloc experiment status {file}`")
    if json:
        results = {"runs": done.rows, "failures": done.failures, "warnings": done.warnings}
        show.document({"folder": str(folder), **results})
        return
    show.table(*_summary(done.rows, metrics))
    show.line()
    show.line(f"results are in {folder}: results.parquet, store/")


@app.command()
@takes_options
def status(file: File, *, options: ExperimentOptions, json: Json = False) -> None:
    """Count the runs of an experiment that are done, failed, missing or damaged. A damaged result differs from its checksum.

    Example: fgloc experiment status lags.toml
    """
    from factorgraph_loc.experiments.experiment import STATES
    from factorgraph_loc.experiments.experiment import status as count_states

    counted = count_states(file, **options.given())
    if json:
        show.document(vars(counted) | {"folder": str(counted.folder)})
        return
    by_label = {label: list(counts.values()) for label, counts in counted.labels.items()}
    total = [sum(numbers) for numbers in zip(*by_label.values(), strict=True)]
    rows = [[label, *map(str, numbers)] for label, numbers in (*by_label.items(), ("(all)", total))]
    show.table(["label", *STATES], rows)
    _print_damaged(counted.damaged, file)
    for run in counted.failures:
        show.line(f"failed: {run['log']}, {run['label']}, seed {run['seed']}: {run['kind']}: {run['reason']}")


@app.command()
@takes_options
def report(file: File, *, options: ExperimentOptions, json: Json = False) -> None:
    """Write the stored results of an experiment as one HTML page, report.html in OUT. Damaged results are left out.

    Example: fgloc experiment report lags.toml
    """
    from factorgraph_loc.experiments.reporting import report as write_page

    written = write_page(file, **options.given())
    if json:
        show.document({"page": str(written.page), "damaged": written.damaged})
        return
    show.line(f"the report is {written.page}")
    _print_damaged(written.damaged, file, "left out")


def _print_plan(prepared: Prepared[Any], jobs: int | None, again: bool, json: bool) -> None:
    import os
    from datetime import timedelta

    from factorgraph_loc.experiments.experiment import estimate_seconds

    todo = prepared.todo(again=again)
    processes = jobs or os.cpu_count() or 1
    seconds = estimate_seconds(todo, prepared.folder) / max(1, min(processes, len(todo)))
    if json:
        keys = ("log", "label", "estimator", "sensors", "prior", "seed", "sweep", "key")
        runs = [{k: getattr(run, k) for k in keys} | {"state": prepared.states[run.key]} for run in prepared.runs]
        show.document({"folder": str(prepared.folder), "runs": runs, "todo": len(todo), "seconds": seconds})
        return
    header = ("log", "label", "sensors", "seed", "sweep", "state")
    show.table(
        header,
        [
            (
                run.log,
                run.label,
                "-" if run.sensors is None else ",".join(run.sensors),
                str(run.seed),
                ", ".join(f"{k}={v}" for k, v in run.sweep.items()) or "-",
                prepared.states[run.key],
            )
            for run in prepared.runs
        ],
    )
    show.line()
    span = timedelta(seconds=round(seconds))
    show.line(f"{len(prepared.runs)} runs, {len(todo)} to do: about {span} with {processes} processes")


def _print_damaged(runs: Sequence[str], file: Path, what: str = "") -> None:
    for run in runs[:SHOWN]:
        show.line(f"damaged{what and f', {what}'}: {run}")
    if len(runs) > SHOWN:
        show.line(f"damaged: {len(runs) - SHOWN} more")
    if runs:
        show.line(f"`fgloc experiment run {file}` repeats the damaged runs")


def _summary(rows: Sequence[dict[str, Any]], metrics: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of the table of results. ``rows``: one dictionary of values for each run.

    A row of the table summarizes the runs with the same label, sensors and swept values. Its cells have the median,
    minimum and maximum of each of the ``metrics``."""
    from statistics import median

    from factorgraph_loc.evaluation.tables import SCORED, counted
    from factorgraph_loc.evaluation.warned import SWEEP

    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        swept = [f"{k.removeprefix(SWEEP)}={v}" for k, v in row.items() if k.startswith(SWEEP) and v is not None]
        groups.setdefault(" ".join([row["label"], *([row["sensors"]] if row["sensors"] else []), *swept]), []).append(
            row
        )
    lines = []
    for name, members in groups.items():
        good = [row for row in members if row["status"] == "ok"]
        cells = []
        for metric in metrics:
            values = [row[metric] for row in good if row.get(metric) is not None]
            cells.append(f"{median(values):.3f} ({min(values):.3f} to {max(values):.3f})" if values else "-")
        cells.append(counted(good) or "-")
        lines.append([name, f"{len(good)} of {len(members)}", *cells])
    return ["median (min to max)", "runs", *metrics, SCORED], lines


World = Annotated[
    str,
    typer.Argument(
        metavar="WORLD",
        help="A preset of `fgloc simulate`, or a TOML file of its settings.",
        autocompletion=completion.preset,
    ),
]
Policies = Annotated[
    str,
    typer.Option(
        metavar="A,B",
        help=f"{', '.join(POLICIES)}; each further policy is compared with the first.",
        autocompletion=completion.policies,
    ),
]
ActiveEstimators = Annotated[
    str,
    typer.Option(
        "--estimator",
        "-e",
        metavar="A,B",
        help=f"{', '.join(ACTIVE_ESTIMATORS)}.",
        autocompletion=completion.active_estimators,
    ),
]
ActiveChanges = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Setting of robot, policy or world, e.g. policy.horizon=8 or world.tags=20; `fgloc policies` lists those of robot "
        "and policy, `fgloc presets WORLD` those of the world. May be repeated.",
        autocompletion=completion.active_setting,
    ),
]


def active(
    world: World,
    out: Out,
    policy: Policies = "information",
    estimator: ActiveEstimators = "active_mcl",
    seeds: Seeds = "0",
    set_: ActiveChanges = None,
    jobs: Jobs = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Simulate robots that drive from an unknown start until they are localized. Policies are compared on the same seeds.

    Example: fgloc active office --seeds 0:5 -o out/active
    """
    from factorgraph_loc.experiments.active import active as seek
    from factorgraph_loc.experiments.active_results import difference_cells, differences, summaries, summary_cells

    show.first_use()
    with show.progress("runs", counted=True) as report:
        results = seek(
            world,
            out,
            policies=parse_list(policy),
            estimators=parse_list(estimator),
            seeds=parse_seeds(seeds),
            changes=nested_changes(set_ or ()),
            jobs=jobs,
            overwrite=overwrite,
            progress=report,
        )
    show.outcome((), results.failures)
    rows = results.rows
    if json:
        tables = {"summaries": summaries(rows), "differences": differences(rows)}
        show.document({"runs": rows, **tables, "failures": results.failures})
    else:
        show.table(*summary_cells(rows))
        header, lines = difference_cells(rows)
        if lines:
            show.line()
            show.table(header, lines)
        show.line()
        show.line(f"results are in {out}: table.md, results.csv, results.parquet, differences.csv, plots/")
    if results.failures:
        raise typer.Exit(1)
