"""``fgloc map``: a map of landmarks, of RFID tags or of points from a log."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from factorgraph_loc.cli import map_texts, show
from factorgraph_loc.cli.options import (
    DataRoot,
    Json,
    LogName,
    LogOptions,
    Overwrite,
    Prior,
    Reader,
    ReaderOption,
    RigFile,
    Settings,
    WorldFile,
    parse_settings,
)

MAPPERS = ("batch", "smoother", "ekf")  # as factorgraph_loc.experiments.maps has them
OutWorld = Annotated[
    Path, typer.Option("--out", "-o", metavar="OUT.world.toml", help="The map to write; a picture goes beside it.")
]


def map_(
    log: LogName,
    out: OutWorld,
    estimator: Annotated[
        str,
        typer.Option(
            "--estimator",
            "-e",
            metavar="NAME",
            help=f"One of {', '.join(MAPPERS)}.",
            autocompletion=lambda incomplete: [name for name in MAPPERS if name.startswith(incomplete)],
        ),
    ] = MAPPERS[0],
    extend: Annotated[bool, typer.Option("--extend", help="Keep the log's map and add what it lacks.")] = False,
    of: Annotated[
        str | None,
        typer.Option(
            metavar="WHAT",
            help="landmarks, tags or points; else points where the log has images, landmarks where it has sightings of them.",
        ),
    ] = None,
    poses: Annotated[
        str | None,
        typer.Option(
            metavar="SOURCE",
            help="For tags and points: reference or odometry, which estimates the poses too; else the reference if there is one.",
        ),
    ] = None,
    tag_height: Annotated[
        float | None,
        typer.Option(metavar="Z", help="Height [m] of tags that the log's map lacks; else that of the antennas."),
    ] = None,
    drop_dead: Annotated[
        bool,
        typer.Option("--drop-dead", help="Map nothing: write the log's map without the tags that are believed dead."),
    ] = False,
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
    """Make a map of the landmarks, RFID tags or points in a log; where the log has a map of landmarks or tags, check that."""
    from factorgraph_loc.experiments import maps

    picture = maps.picture_beside(out, overwrite=overwrite)  # before anything is read
    loaded = LogOptions(reader, reader_option, data_root, rig, world).load_one(log)
    settings = parse_settings(set_ or (), [estimator])[estimator]
    options = maps.MapOptions(of, estimator, settings, extend, poses, tag_height, prior, drop_dead)
    made = maps.make_map(loaded, options, partial(show.progress, counted=False))
    made.write(out, overwrite=overwrite)
    for warning in made.warnings:
        show.note(f"warning: {warning}")
    if json:
        files = {"map": str(out), "picture": str(picture)}
        show.document(map_texts.document(made.details) | {"frame": made.frame, "files": files})
        return
    for line in (*map_texts.tell(made.details), f"the frame of the new map is {made.frame}"):
        show.line(line)
    show.line()
    show.line(f"the map is in {out}, a picture of it in {picture}")
