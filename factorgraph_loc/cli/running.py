"""``fgloc run`` and ``fgloc compare``: one estimator on one log, or several on several."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import (
    DataRoot,
    Json,
    LogName,
    LogNames,
    LogOptions,
    Out,
    Overwrite,
    Prior,
    Reader,
    ReaderOption,
    RigFile,
    Sensors,
    Settings,
    WorldFile,
    parse_list,
    parse_seeds,
    parse_settings,
)

# of the table of one run; column: figure of the scores, digits
COLUMNS = {
    "position RMSE [m]": ("position_rmse", 3),
    "95 % [m]": ("position_p95", 3),
    "max [m]": ("position_max", 3),
    "heading RMSE [rad]": ("heading_rmse", 4),
    "ANEES": ("anees", 2),
}


def run(
    log: LogName,
    estimator: Annotated[str, typer.Option("--estimator", "-e", metavar="NAME", help="The estimator.")],
    out: Out,
    sensors: Sensors = None,
    prior: Prior = None,
    seed: Annotated[int, typer.Option(help="Of the random generator.", min=0)] = 0,
    set_: Settings = None,
    reader: Reader = None,
    reader_option: ReaderOption = None,
    data_root: DataRoot = None,
    rig: RigFile = None,
    world: WorldFile = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Run one estimator on one log; write trajectories, estimates and scores."""
    from factorgraph_loc.estimators.registry import check_names
    from factorgraph_loc.experiments import run as experiment
    from factorgraph_loc.experiments.output import check_free, write_run

    check_names([estimator])
    check_free(out, overwrite=overwrite)  # now, not when all is computed
    settings = parse_settings(set_ or (), [estimator])[estimator]
    loaded = LogOptions(reader, reader_option, data_root, rig, world).load_one(log)
    config = experiment.RunConfig(estimator, settings, parse_list(sensors) if sensors else None, prior, seed)
    with show.progress(estimator, counted=False) as report:
        result = experiment.run(loaded, config, lambda share: report(share, 1.0))
    scores = write_run(result, loaded, out, overwrite=overwrite)
    for warning in result.warnings:
        show.note(f"warning: {warning}")
    if json:
        show.document(scores)
        return
    _print_scores(scores)
    typer.echo(f"\nresults are in {out}")


def compare(
    logs: LogNames,
    estimators: Annotated[str, typer.Option("--estimators", "-e", metavar="A,B", help="The estimators.")],
    out: Out,
    seeds: Annotated[str, typer.Option(metavar="FIRST:END", help="Seeds, END not included; or one number.")] = "0",
    jobs: Annotated[int | None, typer.Option(help="Processes; else one per core.", min=1)] = None,
    sensors: Sensors = None,
    prior: Prior = None,
    set_: Settings = None,
    reader: Reader = None,
    reader_option: ReaderOption = None,
    data_root: DataRoot = None,
    rig: RigFile = None,
    world: WorldFile = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Run several estimators on several logs; write a table and plots."""
    from factorgraph_loc.estimators.registry import check_names
    from factorgraph_loc.evaluation.tables import comparison_table, verdict
    from factorgraph_loc.experiments import compare as experiment
    from factorgraph_loc.experiments.run import RunConfig

    names = parse_list(estimators)
    check_names(names)
    experiment.check_free(out, overwrite=overwrite)  # now, not when all logs are read
    settings = parse_settings(set_ or (), names)
    chosen = parse_seeds(seeds)
    loaded = LogOptions(reader, reader_option, data_root, rig, world).load(logs)
    used = parse_list(sensors) if sensors else None
    configs = [RunConfig(name, settings[name], used, prior, seed) for name in names for seed in chosen]
    with show.progress("runs", counted=True) as report:
        comparison = experiment.compare(loaded, configs, out, jobs=jobs, overwrite=overwrite, progress=report)
    for failure in comparison.failures:
        show.note(f"failed: {failure}")
    if json:
        show.document({"runs": comparison.rows, "failures": comparison.failures})
    else:
        show.rich_table(comparison_table(comparison.rows))
        for line in verdict(comparison.rows):
            typer.echo(line)
        typer.echo(f"\nresults are in {out}: table.md, results.csv, results.parquet, differences.csv, plots/, runs/")
    if comparison.failures:
        raise typer.Exit(1)


def _print_scores(scores: Mapping[str, Any]) -> None:
    if scores["causal.position_rmse"] is not None or scores["final.position_rmse"] is not None:
        rows = [
            (kind, *(show.number(scores[f"{kind}.{figure}"], digits) for figure, digits in COLUMNS.values()))
            for kind in ("causal", "final")
        ]
        show.table(("", *COLUMNS), rows)
    else:
        typer.echo("there is no reference to score against")
        for name, value in scores.items():
            if name.startswith("nis.") and name.endswith(".mean_per_dof"):
                typer.echo(
                    f"{name.split('.')[1]}: normalised innovation squared {value:.2f} per degree of freedom, ideally 1"
                )
    counts = ", ".join(f"{scores[f'{kind}.total']} {kind}" for kind in ("ignored", "rejected", "late"))
    typer.echo(f"measurements: {counts}")
    final = f"{show.number(scores['timing.final_seconds'], 1)} s for the final trajectory"
    if scores["time_to_localized"] is None:  # it only collected what came
        typer.echo(f"time: {final}")
        return
    median, factor = (
        show.number(scores[f"timing.{name}"], n) for name, n in (("update_ms_median", 2), ("real_time_factor", 0))
    )
    typer.echo(f"time: {median} ms per update (median), {factor} times real time, {final}")
