"""``fgloc map``: a map of landmarks, RFID tags or points from a log."""

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

MAPPERS = ("batch", "smoother", "ekf")  # as in factorgraph_loc.experiments.maps
OutWorld = Annotated[
    Path,
    typer.Option("--out", "-o", metavar="OUT.world.toml", help="The map to write; a picture is written next to it."),
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
            help="landmarks, tags or points; by default points if the log has images, landmarks if it has sightings of them.",
        ),
    ] = None,
    poses: Annotated[
        str | None,
        typer.Option(
            metavar="SOURCE",
            help="For tags and points: reference, or odometry to estimate the poses too; by default the reference if there is one.",
        ),
    ] = None,
    tag_height: Annotated[
        float | None,
        typer.Option(metavar="Z", help="Height [m] of tags that the log's map lacks; by default that of the antennas."),
    ] = None,
    drop_dead: Annotated[
        bool,
        typer.Option("--drop-dead", help="Only write the log's map without the tags that are believed dead."),
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
    """Make a map of the landmarks, RFID tags or points in a log; compare it with the log's map of landmarks or tags, if any."""
    from factorgraph_loc.experiments import maps

    picture = maps.picture_beside(out, overwrite=overwrite)  # before the log is read
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
