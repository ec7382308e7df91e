"""``fgloc features``: repeatability and matching of point features."""

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import Json, Out, Overwrite, parse_list
from factorgraph_loc.errors import InputError
from factorgraph_loc.plugins import FEATURES
from factorgraph_loc.text import quoted

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Point features of images and their quality.")
ALL = ",".join(FEATURES)


@app.command()
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
