"""The commands ``fgloc score``, which compares two trajectories, and ``fgloc features``, which compares kinds of point features."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import Json, MaxGap, Out, Overwrite, parse_list, takes_options
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.scoring import MAX_DIFF, MAX_GAP, Alignment, Association
from factorgraph_loc.plugins import FEATURES
from factorgraph_loc.text import quoted


@dataclass(frozen=True)
class ScoreOptions:
    """The options of ``fgloc score`` that are arguments of :func:`factorgraph_loc.api.results.score`."""

    align: Annotated[
        Alignment,
        typer.Option(
            help="How the estimate is moved onto the reference first: not at all, first pose onto first pose, or by least "
            "squares in the plane, about the vertical and along it, in space, or in space with a scale."
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
            "--all-pairs",
            help="Compute relative errors over overlapping pieces, one from each pose, not over consecutive ones.",
        ),
    ] = False
    align_poses: Annotated[
        int | None, typer.Option(metavar="N", help="Align by the first N poses only. Default: by all poses.")
    ] = None
    delta: Annotated[
        list[str] | None,
        typer.Option(metavar="5m|2s", help="Add relative errors over this distance or duration. May be repeated."),
    ] = None
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="OUT", help="Folder for the results. Default: results are only printed."),
    ] = None
    overwrite: Overwrite = False


@takes_options
def score(
    estimate: Annotated[
        str,
        typer.Argument(
            metavar="ESTIMATE",
            help="A file of poses (TUM, KITTI or EuRoC), BAG:TOPIC, BAG:/tf:PARENT.CHILD, the folder of a run, or a log, whose "
            "reference is used.",
        ),
    ],
    reference: Annotated[
        str, typer.Argument(metavar="REFERENCE", help="Another trajectory, given in any form of ESTIMATE.")
    ],
    aligned: Annotated[bool, typer.Option("-a", help="As in evo: --align se3.")] = False,
    *,
    options: ScoreOptions,
    json: Json = False,
) -> None:
    """Score any trajectory against any other: absolute and relative errors, with or without alignment.

    Example: fgloc score out/plaza1 plaza1 --align se2
    """
    from factorgraph_loc.api import results
    from factorgraph_loc.evaluation.trajectories.page import errors_table, extents

    if aligned and options.align not in ("none", "se3"):
        raise InputError(f"-a is --align se3, but --align is {options.align}: give one of them")
    given = vars(options) | {"delta": options.delta or (), "align": "se3" if aligned else options.align}
    result = results.score(estimate, reference, **given)
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


features = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Point features of images and their quality.")
ALL = ",".join(FEATURES)


@features.command()
def evaluate(
    images: Annotated[
        list[Path],
        typer.Argument(
            metavar="IMAGES...",
            help="Folders with img1, img2, ... and H1to2p, ... (or folders of these), or photographs, which are warped.",
        ),
    ],
    out: Out,
    features: Annotated[str, typer.Option(metavar="A,B", help="Features to compare.")] = ALL,
    count: Annotated[int, typer.Option(min=1, help="Points per image, the strongest of each feature.")] = 1000,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Compare features on images of planar scenes: repeatability, matching, time.

    Example: fgloc features evaluate images/graffiti -o out/graffiti
    """
    from factorgraph_loc.api import learning
    from factorgraph_loc.evaluation.features import scores as evaluation

    names = list(dict.fromkeys(parse_list(features)))
    if not names:
        raise InputError(f"--features is {quoted(features)}, expected names such as {ALL}")
    with show.progress("evaluating", counted=True) as progress:
        scores = learning.features(images, out, features=names, count=count, overwrite=overwrite, progress=progress)
    if json:
        show.document(scores.to_dicts())
        return
    show.table(*evaluation.summary(scores))
    show.line()
    show.line(f"results are in {out}: {', '.join(evaluation.FILES)}")
