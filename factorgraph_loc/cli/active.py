"""``fgloc active``: simulated robots that plan their paths to localize themselves."""

from __future__ import annotations

from typing import Annotated

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import Json, Out, Overwrite, parse_list
from factorgraph_loc.cli.simulating import nested_changes
from factorgraph_loc.experiments.seeds import parse_seeds


def active(
    world: Annotated[
        str, typer.Argument(metavar="WORLD", help="A preset of `fgloc simulate`, or a TOML file of its settings.")
    ],
    out: Out,
    policy: Annotated[
        str,
        typer.Option(
            metavar="A,B",
            help="information, paper_literal, random, patrol, nearest_tags; the others are compared with the first.",
        ),
    ] = "information",
    estimator: Annotated[
        str, typer.Option("--estimator", "-e", metavar="A,B", help="active_mcl, particle_filter, smoother.")
    ] = "active_mcl",
    seeds: Annotated[str, typer.Option(metavar="FIRST:END", help="Seeds, END not included; or one number.")] = "0",
    max_metres: Annotated[
        float | None, typer.Option(metavar="M", help="Path length after which a robot gives up [m]; by default 100.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Setting of robot, policy or world, e.g. policy.horizon=8 or world.tags=20; may be repeated.",
        ),
    ] = None,
    jobs: Annotated[int | None, typer.Option(help="Number of processes; by default one per core.", min=1)] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Drive simulated robots from an unknown start until they are localized, and compare policies on the same seeds."""
    from factorgraph_loc.api.experimenting import active_settings
    from factorgraph_loc.evaluation.active import difference_cells, differences, summaries, summary_cells
    from factorgraph_loc.experiments.active import seek

    chosen = parse_seeds(seeds)
    simulation, settings = active_settings(world, nested_changes({"max_metres": max_metres}, set_ or []))
    show.first_use()
    with show.progress("runs", counted=True) as report:
        results = seek(
            simulation,
            parse_list(policy),
            parse_list(estimator),
            chosen,
            out,
            settings,
            jobs=jobs,
            overwrite=overwrite,
            progress=report,
        )
    for failure in results.failures:
        show.note(f"failed: {failure}")
    if json:
        found = {"summaries": summaries(results.rows), "differences": differences(results.rows)}
        show.document({"runs": results.rows, **found, "failures": results.failures})
    else:
        show.table(*summary_cells(results.rows))
        header, lines = difference_cells(results.rows)
        if lines:
            show.line()
            show.table(header, lines)
        show.line()
        show.line(f"results are in {out}: table.md, results.csv, results.parquet, differences.csv, plots/")
    if results.failures:
        raise typer.Exit(1)
