"""``fgloc images`` and ``fgloc features``: accuracy of image localization in a map made from other images; repeatability and
matching of point features."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import (
    DataRoot,
    Json,
    LogName,
    LogOptions,
    Out,
    Overwrite,
    Reader,
    ReaderOption,
    RigFile,
    parse_list,
)
from factorgraph_loc.errors import InputError
from factorgraph_loc.text import quoted

RANGE = "FIRST:END or FIRST:END:STEP"
features = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Point features of images and their quality.")
ALL = "colour,sift,orb,fast_hessian,harris_laplace,hessian_laplace"


def images(
    log: LogName,
    out: Out,
    map_: Annotated[str, typer.Option("--map", metavar="RANGE", help=f"Images for the map, numbered from 0: {RANGE}.")],
    query: Annotated[
        list[str], typer.Option(metavar="NAME=RANGE", help="A sequence of images to localize; may be repeated.")
    ],
    feature: Annotated[str, typer.Option(metavar="A,B", help="Features to compare.")] = "colour,sift,orb",
    count: Annotated[int, typer.Option(min=10, max=20_000, help="Features per image.")] = 1500,
    reader: Reader = None,
    reader_option: ReaderOption = None,
    data_root: DataRoot = None,
    rig: RigFile = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Map some images of a log with their reference poses, localize others, and report the errors."""
    from factorgraph_loc.experiments import image_localization as evaluation
    from factorgraph_loc.vision.features import extractor

    mapped = parse_range(map_, "--map")
    queries = dict(_query(text) for text in query)
    names = list(dict.fromkeys(parse_list(feature)))
    if not names:
        raise InputError(f"--feature is {quoted(feature)}, expected names such as colour,sift,orb")
    for name in names:
        extractor(name, count)
    evaluation.check_free(out, overwrite=overwrite)  # before the computation
    loaded = LogOptions(reader, reader_option, data_root, rig).load_one(log)
    with show.progress("images", counted=False) as report:
        results = evaluation.evaluate_images(loaded, names, count, mapped, queries, lambda share: report(share, 1.0))
    evaluation.write_results(loaded.name, results, out)
    for warning in (*loaded.warnings, *results.warnings):
        show.note(f"warning: {warning}")
    if json:
        outcomes = [
            {
                "feature": one.feature,
                "query": one.query,
                "method": one.method,
                "success": one.success,
                "position": one.position.tolist(),
                "angle": one.angle.tolist(),
            }
            for one in results.outcomes
        ]
        show.document({"maps": {name: asdict(made) for name, made in results.maps.items()}, "outcomes": outcomes})
        return
    show.table(*evaluation.table(results))
    show.line()
    show.line(f"results are in {out}: {', '.join(evaluation.FILES)}")


def parse_range(text: str, option: str) -> range:
    """``0:200:2`` as the numbers 0, 2, ... 198; InputError if the text is invalid."""
    try:
        found = range(*(int(part) for part in text.split(":")))
    except (TypeError, ValueError):
        found = range(0)
    if ":" not in text or not found or min(found) < 0 or found.step < 1:
        raise InputError(f"{option} is {quoted(text)}, expected a range of images such as 0:200:2")
    return found


def _query(text: str) -> tuple[str, range]:
    name, equals, numbers = text.partition("=")
    if not (name and equals):
        raise InputError(f"--query is {quoted(text)}, expected a name and a range of images such as A=1:200:2")
    return name, parse_range(numbers, "--query")


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
    features: Annotated[str, typer.Option(metavar="A,B", help="Features and detectors to compare.")] = ALL,
    count: Annotated[int, typer.Option(min=1, help="Points per image, the strongest of each feature.")] = 1000,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Compare features on images of planar scenes: repeatability, matching, estimated homography, time."""
    from factorgraph_loc.evaluation.features import scores as evaluation
    from factorgraph_loc.evaluation.features.feature_evaluation import feature
    from factorgraph_loc.evaluation.features.sequences import find_sequences

    names = list(dict.fromkeys(parse_list(features)))
    if not names:
        raise InputError(f"--features is {quoted(features)}, expected names such as {ALL}")
    chosen = [feature(name, count) for name in names]
    evaluation.check_free(out, overwrite=overwrite)  # before the computation
    sequences = find_sequences(images)
    with show.progress("evaluating", counted=True) as progress:
        scores = evaluation.evaluate_all(sequences, chosen, progress)
    evaluation.write_scores(scores, out)
    if json:
        show.document(scores.rows)
        return
    show.table(*evaluation.summary(scores))
    show.line()
    show.line(f"results are in {out}: {', '.join(evaluation.FILES)}")
