"""The commands ``fgloc run``, which runs one estimator on one log, and ``fgloc compare``, which runs several on several logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import (
    Estimator,
    Estimators,
    Jobs,
    Json,
    LogName,
    LogNames,
    LogOptions,
    Out,
    RunOptions,
    Seeds,
    parse_list,
    parse_settings,
    takes_options,
)
from factorgraph_loc.evaluation.scores import ACCURACY, metric_of
from factorgraph_loc.model.scoring import KINDS, parse_seeds
from factorgraph_loc.text import number

if TYPE_CHECKING:
    from factorgraph_loc.fitting.posterior import FittedConstant
    from factorgraph_loc.model.result import RunResult

SHOWN_CONSTANTS, SHOWN_EVENTS = 10, 5  # maximum numbers that are printed; the files of the results have all

COLUMNS = {  # titles of the columns of the table of a run, by the name of the score
    "position_rmse": "position RMSE [m]",
    "position_p95": "95 % [m]",
    "position_max": "max [m]",
    "heading_rmse": "heading RMSE [rad]",
    "anees": "ANEES",
    "scored": "poses scored",
}


@takes_options
def run(
    log: LogName,
    estimator: Estimator,
    out: Out,
    *,
    source: LogOptions,
    options: RunOptions,
    seed: Annotated[int, typer.Option(help="Seed of the random generator.", min=0)] = 0,
    learn: Annotated[
        bool,
        typer.Option(
            "--learn",
            help="Learn the rig from the log, without the reference. Only the final trajectory uses the learnt rig.",
        ),
    ] = False,
    json: Json = False,
) -> None:
    """Run one estimator on one log; write trajectories, estimates, scores and plots.

    Example: fgloc run plaza1 -e smoother -o out/plaza1
    """
    from factorgraph_loc.api import running
    from factorgraph_loc.experiments.output import MAP
    from factorgraph_loc.files.temporary import require_free
    from factorgraph_loc.fusion.registry import check_names
    from factorgraph_loc.io.results import FILES

    check_names([estimator])
    require_free(out, FILES, overwrite=options.overwrite)  # checked before the log is read, which is slow
    settings = parse_settings(options.set_ or (), [estimator])
    loaded = source.load_one(log)
    show.first_use()
    with show.progress(estimator, counted=False) as report:
        outcome = running.run(
            loaded,
            estimator,
            settings=settings[estimator],
            seed=seed,
            learn=learn,
            out=out,
            progress=lambda share: report(share, 1.0),
            **options.given(),
        )
    result, scores = outcome.result, outcome.scores
    show.warnings(scores["warnings"])
    if json:
        show.document(scores | {"warnings": [str(warning) for warning in scores["warnings"]]})
        return
    _print_accuracy(scores)
    _print_further(scores, rpe=options.rpe)
    _print_consistency(scores)
    _print_learnt(result)
    _print_rig(outcome.learnt)
    _print_events(result)
    _print_effort(scores)
    show.line()
    show.line(f"results are in {out}")
    if (out / MAP).exists():
        show.line(f"a map with the {len(result.learnt.points or ())} points that the run estimated is in {out / MAP}")


@takes_options
def compare(
    logs: LogNames,
    estimators: Estimators,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="OUT", help="Folder for the results; by default a new one below out."),
    ] = None,
    seeds: Seeds = "0",
    jobs: Jobs = None,
    *,
    source: LogOptions,
    options: RunOptions,
    json: Json = False,
) -> None:
    """Run several estimators on several logs; write a table and plots.

    Example: fgloc compare monday.toml -e ekf,smoother
    """
    from factorgraph_loc.evaluation.tables import comparison_cells, further_tables, unscored, verdict
    from factorgraph_loc.experiments.compare import FINISHED
    from factorgraph_loc.experiments.compare import compare as compare_estimators
    from factorgraph_loc.files.temporary import require_free
    from factorgraph_loc.fusion.registry import check_names

    names = parse_list(estimators)
    check_names(names)
    if out is not None:
        require_free(out, FINISHED, overwrite=options.overwrite)  # checked before the logs are read, which is slow
    settings = parse_settings(options.set_ or (), names)
    chosen = parse_seeds(seeds)
    loaded = source.load(logs)
    show.first_use()
    with show.progress("runs", counted=True) as report:
        comparison = compare_estimators(
            loaded,
            names,
            out,
            settings=settings,
            seeds=chosen,
            rpe=options.rpe,
            jobs=jobs,
            progress=report,
            **options.given(),
        )
    show.outcome(comparison.warnings, comparison.failures)
    if json:
        show.document({"runs": comparison.rows, "failures": comparison.failures, "warnings": comparison.warnings})
    else:
        show.table(*comparison_cells(comparison.rows), grouped=True)
        for title, columns in further_tables(comparison.rows, rpe=options.rpe).items():
            show.line(f"{title}:")
            show.table(*comparison_cells(comparison.rows, columns), grouped=True)
        for line in (*unscored(comparison.rows), *verdict(comparison.rows)):
            show.line(line)
        show.line()
        show.line(
            f"results are in {comparison.out}: report.html, table.md, results.csv, results.parquet, differences.csv, plots/, store/"
        )
    if comparison.failures:
        raise typer.Exit(1)


def _print_rig(learnt: Sequence[FittedConstant]) -> None:
    if learnt:
        from factorgraph_loc.calibration.report import constants_table

        show.line("values learnt from the log, which only the final trajectory uses:")
        show.table(*constants_table(learnt))


def _print_accuracy(scores: Mapping[str, Any]) -> None:
    if scores["causal.position_rmse"] is not None or scores["final.position_rmse"] is not None:
        rows = [
            (kind, *(number(scores[f"{kind}.{name}"], ACCURACY[name].digits) for name in COLUMNS)) for kind in KINDS
        ]
        show.table(("", *COLUMNS.values()), rows)
    else:
        scored = scores["final.scored"]
        has_none = "the run is not scored, because the log has no reference"
        show.line(has_none if scored is None else f"no scores: the reference covers too few poses, {scored}")
    if scores["landmarks.count"]:
        error, anees = (number(scores[f"landmarks.{what}"], n) for what, n in (("rmse", 3), ("anees", 2)))
        show.line(f"learnt landmarks: {scores['landmarks.count']}, aligned RMSE {error} m, ANEES {anees}, ideal 2")
    if scores["time_to_localized"]:
        show.line(f"localized after {scores['time_to_localized']:.1f} s")


def _print_further(scores: Mapping[str, Any], *, rpe: bool) -> None:
    """Print tables of further scores, if they have values. ``rpe``: include the table of relative pose errors."""
    from factorgraph_loc.evaluation.tables import further_tables

    for title, keys in further_tables([scores], rpe=rpe).items():
        metrics = {kind: [metric_of(key) for key in keys if key.startswith(kind)] for kind in KINDS}
        rows = [
            (kind, *(number(scores[metric.key], metric.digits) for metric in some)) for kind, some in metrics.items()
        ]
        if any(cell != "-" for row in rows for cell in row[1:]):
            names = [metric.column.removeprefix(f"{KINDS[0]} ") for metric in metrics[KINDS[0]]]
            show.line(f"{title}:")
            show.table(("", *names), rows)


def _print_consistency(scores: Mapping[str, Any]) -> None:
    for name, value in scores.items():
        if name.startswith("nis.") and name.endswith(".median_ratio") and value is not None:
            sensor = name.removeprefix("nis.").removesuffix(".median_ratio")
            # a few gross outliers would dominate the mean
            share = 100.0 * scores[f"nis.{sensor}.beyond_95"]
            show.line(
                f"{sensor}: normalised innovation squared {value:.2f} times the expected median, ideal 1; "
                f"{share:.1f} % beyond the 95 % bound, ideal 5"
            )


def _print_learnt(result: RunResult) -> None:
    constants = result.learnt.values
    for name, (value, sigma) in islice(constants.items(), SHOWN_CONSTANTS):
        show.line(f"learnt: {name} {value:.5g} ± {sigma:.2g}")
    if len(constants) > SHOWN_CONSTANTS:
        show.line(f"learnt: {len(constants) - SHOWN_CONSTANTS} more in learnt.json")


def _print_events(result: RunResult) -> None:
    events = result.diagnostics.events
    if events:
        more = f", the first {SHOWN_EVENTS}; all are in events.csv" if len(events) > SHOWN_EVENTS else ""
        show.line(f"events: {len(events)}{more}")
    for event in events[:SHOWN_EVENTS]:
        show.line(f"  at {event.t:.1f} s: {event}")


def _print_effort(scores: Mapping[str, Any]) -> None:
    counts = ", ".join(f"{scores[f'{kind}.total']} {kind}" for kind in ("ignored", "rejected", "late"))
    show.line(f"measurements: {counts}")
    if images := scores["timing.images"]:
        seconds = scores["timing.frontend_seconds"]
        show.line(
            f"images: features of {images} computed or loaded from the cache in {seconds:.1f} s, {images / seconds:.0f} per second"
        )
    final = f"{number(scores['timing.final_seconds'], 1)} s for the final trajectory"
    if scores["time_to_localized"] is None:  # a batch estimator has no causal updates
        show.line(f"time: {final}")
        return
    median, factor = (
        number(scores[f"timing.{name}"], n) for name, n in (("update_ms_median", 2), ("real_time_factor", 0))
    )
    show.line(f"time: {median} ms per update (median), {factor} times real time, {final}")
