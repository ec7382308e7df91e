"""``fgloc score``: one trajectory against another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import Json, MaxGap, Overwrite, takes_options
from factorgraph_loc.model.scoring import MAX_DIFF, MAX_GAP, Alignment, Association


@dataclass(frozen=True)
class ScoreOptions:
    """The arguments of ``score`` of the Python interface."""

    align: Annotated[
        Alignment,
        typer.Option(
            help="How the estimate is moved onto the reference first: not at all, first pose onto first pose, or by least "
            "squares in the plane, in space, or in space with a scale."
        ),
    ] = "none"
    associate: Annotated[
        Association,
        typer.Option(
            help="Which poses are compared: those with the nearest stamps, or estimates interpolated at the stamps of the "
            "reference, as runs are scored."
        ),
    ] = "nearest"
    max_diff: Annotated[float, typer.Option(metavar="SECONDS", help="Largest difference of the nearest stamps.")] = (
        MAX_DIFF
    )
    max_gap: MaxGap = MAX_GAP
    all_pairs: Annotated[
        bool,
        typer.Option(
            "--all-pairs", help="Relative errors over pieces from each pose on, instead of one after the other."
        ),
    ] = False
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="OUT", help="Folder for the results; without it they are printed."),
    ] = None
    overwrite: Overwrite = False


@takes_options
def score(
    estimate: Annotated[
        str,
        typer.Argument(
            metavar="ESTIMATE",
            help="A file of poses (TUM, KITTI or EuRoC), BAG:TOPIC, BAG:/tf:PARENT.CHILD, the folder of a run, or a log, which "
            "stands for its reference.",
        ),
    ],
    reference: Annotated[str, typer.Argument(metavar="REFERENCE", help="Another one, of any of these kinds.")],
    *,
    options: ScoreOptions,
    json: Json = False,
) -> None:
    """Score any trajectory against any other: absolute and relative errors, with or without alignment.

    Example: fgloc score out/plaza1 plaza1 --align se2
    """
    from factorgraph_loc.api import results
    from factorgraph_loc.evaluation.trajectories.page import errors_table, extents

    result = results.score(estimate, reference, **vars(options))
    show.warnings(result.warnings)
    if json:
        show.document(result.document())
        return
    show.fields(extents(result))
    show.line()
    show.table(*errors_table(result))
    if options.out is not None:
        show.line()
        show.line(f"results are in {options.out}: report.html, score.json, errors.csv, plots/")
