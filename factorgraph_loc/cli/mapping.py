"""``fgloc map``: a map of landmarks, of RFID tags or of points from a log, and what it says about the map that the log has."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_loc.cli import mapping_tags, show
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

if TYPE_CHECKING:
    from factorgraph_loc.experiments.maps import DroppedTags
    from factorgraph_loc.mapping.mapping import LandmarkMap
    from factorgraph_loc.mapping.point_mapping import PointReport
    from factorgraph_loc.mapping.tag_mapping import MadeTags

MAPPERS = ("batch", "smoother", "ekf")  # as factorgraph_loc.experiments.maps has them
HEADER = ("landmark", "given x [m]", "y [m]", "learnt x [m]", "y [m]", "sigma [m]", "distance [m]", "verdict")
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
        show.document(
            _document(made.details) | {"frame": made.frame, "files": {"map": str(out), "picture": str(picture)}}
        )
        return
    for line in (*_tell(made.details), f"the frame of the new map is {made.frame}"):
        show.line(line)
    show.line()
    show.line(f"the map is in {out}, a picture of it in {picture}")


def _tell(found: LandmarkMap | MadeTags | PointReport | DroppedTags) -> tuple[str, ...]:
    """Print the table of what was found, where there is one, and return what there is to say of it."""
    from factorgraph_loc.experiments.maps import DroppedTags
    from factorgraph_loc.mapping.mapping import LandmarkMap
    from factorgraph_loc.mapping.tag_mapping import MadeTags

    if isinstance(found, DroppedTags):
        return mapping_tags.tell_dropped(found)
    if isinstance(found, LandmarkMap):
        show.table(HEADER, _rows(found))
        show.line()
        return (found.summary(), *found.notes)
    if isinstance(found, MadeTags):
        show.table(mapping_tags.HEADER, mapping_tags.rows(found))
        show.line()
        return (found.made.summary("tags"), *mapping_tags.notes(found))
    return (
        f"{found.points} points are in the new map, with {found.observations} observations in {found.keyframes} keyframes",
        f"reprojection residual: {found.rms:.2f} px root mean square, {found.mad:.2f} px median",
        f"parallax {found.parallax:.3f} rad, standard deviation in the worst direction {found.sigma:.3f} m (medians)",
        f"the cameras were moved by {found.shifted:.3f} m and {found.turned:.4f} rad (medians)",
    )


def _rows(made: LandmarkMap) -> list[tuple[str, ...]]:
    rows = []
    for entry in made.entries:
        given = (None, None) if entry.given is None else entry.given
        learnt = (None, None) if entry.learnt is None else entry.learnt.position
        numbers = (*given, *learnt, entry.sigma, entry.distance)
        rows.append((entry.landmark, *(show.number(value) for value in numbers), entry.verdict))
    return rows


def _document(found: LandmarkMap | MadeTags | PointReport | DroppedTags) -> dict[str, Any]:
    from factorgraph_loc.mapping.mapping import LandmarkMap
    from factorgraph_loc.mapping.tag_mapping import MadeTags

    if isinstance(found, LandmarkMap):
        return _landmark_document(found)
    return mapping_tags.document(found) if isinstance(found, MadeTags) else asdict(found)


def _landmark_document(made: LandmarkMap) -> dict[str, Any]:
    landmarks = [
        {
            "landmark": entry.landmark,
            "given": None if entry.given is None else entry.given.tolist(),
            "learnt": None if entry.learnt is None else entry.learnt.position.tolist(),
            "covariance": None if entry.learnt is None else entry.learnt.covariance.tolist(),
            "sigma": entry.sigma,
            "distance": entry.distance,
            "verdict": entry.verdict,
            "flagged": entry.flagged,
        }
        for entry in made.entries
    ]
    return {"landmarks": landmarks, "summary": made.summary(), "notes": [*made.notes]}
