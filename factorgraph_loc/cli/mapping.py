"""``fgloc map``: a map of landmarks, of RFID tags or of points from a log, and what it says about the map that the log has."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_loc.cli import show
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
from factorgraph_loc.errors import InputError

if TYPE_CHECKING:
    from factorgraph_loc.calibration.mapping import LandmarkMap
    from factorgraph_loc.log import Log

SUFFIX = ".world.toml"
MAPPERS = ("batch", "smoother", "ekf")  # the estimators that estimate landmarks
START_SIGMA = 1e-3  # m and rad; without a map the start is what defines the frame
SOURCES = {"log": "the log's start", "reference": "its reference"}
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
    picture = _picture_beside(out, overwrite=overwrite)
    options = LogOptions(reader, reader_option, data_root, rig, world)
    loaded = options.load_one(log)
    of_landmarks, of_tags = bool(set_ or estimator != MAPPERS[0]), tag_height is not None
    if _maps_points(loaded, of, of_others=of_landmarks or of_tags or extend):
        from factorgraph_loc.cli.mapping_points import PointOptions
        from factorgraph_loc.cli.mapping_points import map_log as map_points

        map_points(loaded, PointOptions(poses, prior, json), out, picture)
        return
    if _maps_tags(loaded, of, of_landmarks=of_landmarks, of_tags=of_tags or poses is not None):
        from factorgraph_loc.cli.mapping_tags import TagOptions, map_log

        map_log(loaded, TagOptions(poses, prior, tag_height, extend=extend, json=json), out, picture)
        return
    if estimator not in MAPPERS:
        raise InputError(f"--estimator is {estimator!r}, expected one that estimates landmarks: {', '.join(MAPPERS)}")
    settings = parse_settings(set_ or (), [estimator])[estimator]
    if "landmarks" in settings:
        raise InputError(f"--set is {estimator}.landmarks, but a map is made without the log's map, or with --extend")
    from factorgraph_loc.calibration import map_figure, mapping
    from factorgraph_loc.evaluation.figures import save
    from factorgraph_loc.experiments.run import RunConfig, run
    from factorgraph_loc.files import replacing
    from factorgraph_loc.world import write_world
    from factors import se2

    mapping.check(loaded)
    if extend and not loaded.world.landmarks:
        raise InputError(f"{loaded.name}: has no map that could be extended; leave --extend out")
    source = ""
    if extend:
        started, config = loaded, RunConfig(estimator, settings | {"landmarks": "extended"}, prior=prior)
    else:
        started, source = started_exactly(loaded, prior)
        config = RunConfig(estimator, settings | {"landmarks": "unknown"}, prior="log")
    with show.progress(estimator, counted=False) as report:
        result = run(started, config, lambda share: report(share, 1.0))
    made = mapping.make_map(loaded, result.learnt.landmarks, extend=extend)
    trajectory = se2.compose(made.frame, result.final.poses)
    try:
        with replacing(picture) as temporary:
            save(map_figure.figure(loaded.name, made, trajectory), temporary)
        write_world(made.world, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    for warning in result.warnings:
        show.note(f"warning: {warning}")
    frame = "that of the given map" if extend or made.judged else f"that of the start: {source}"
    if json:
        show.document(_document(made, frame) | {"files": {"map": str(out), "picture": str(picture)}})
        return
    _print_table(made)
    typer.echo()
    for line in (made.summary(), *made.notes, f"the frame of the new map is {frame}"):
        typer.echo(line)
    typer.echo(f"\nthe map is in {out}, a picture of it in {picture}")


def _maps_points(log: Log, of: str | None, *, of_others: bool) -> bool:
    """Whether points are mapped; InputError for options of the other kinds."""
    if of == "points" and of_others:
        raise InputError("--estimator, --set, --extend and --tag-height are for other maps, but points are mapped here")
    return of == "points" or (of is None and not of_others and "camera" in log.streams and log.rig.camera is not None)


def _maps_tags(log: Log, of: str | None, *, of_landmarks: bool, of_tags: bool) -> bool:
    """Whether tags are mapped rather than landmarks; InputError for options of the other kind."""
    if of not in (None, "landmarks", "tags"):
        raise InputError(f"--of is {of!r}, expected landmarks, tags or points")
    tags = of == "tags" or (of is None and "bearing_range" not in log.streams and "rfid" in log.streams)
    if tags and of_landmarks:
        raise InputError("--estimator and --set are for maps of landmarks, but tags are mapped here")
    if not tags and of_tags:
        raise InputError("--poses and --tag-height are for maps of tags, but landmarks are mapped here")
    return tags


def started_exactly(log: Log, prior: str | None) -> tuple[Log, str]:
    """The log with a start that is certain, and where that lies, in words."""
    from dataclasses import replace

    import numpy as np

    from factorgraph_loc.experiments.prior import first_odometry, resolve_prior
    from factorgraph_loc.log import StartPose

    start, source = resolve_prior(log, prior)
    if start is None:
        t, pose, source = first_odometry(log), np.zeros(3), "the first pose is the origin (0, 0, 0)"
    else:
        t, pose = start.t, start.pose
        x, y, heading = pose
        source = f"the robot starts at ({x:.3f} m, {y:.3f} m, {heading:.3f} rad), from {SOURCES.get(source, '--prior')}"
    return replace(log, start=StartPose(t, pose, np.full(3, START_SIGMA))), source


def _print_table(made: LandmarkMap) -> None:
    rows = []
    for entry in made.entries:
        given = (None, None) if entry.given is None else entry.given
        learnt = (None, None) if entry.learnt is None else entry.learnt.position
        numbers = (*given, *learnt, entry.sigma, entry.distance)
        rows.append((entry.landmark, *(show.number(value) for value in numbers), entry.verdict))
    show.table(HEADER, rows)


def _document(made: LandmarkMap, frame: str) -> dict[str, Any]:
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
    return {"landmarks": landmarks, "summary": made.summary(), "notes": [*made.notes], "frame": frame}


def _picture_beside(out: Path, *, overwrite: bool) -> Path:
    """The picture's path; InputError if the map's name is not one, or something is there already."""
    name = out.name.removesuffix(SUFFIX)
    if name in ("", out.name):
        raise InputError(f"--out is {str(out)!r}, expected a name that ends in {SUFFIX}")
    if not out.parent.is_dir():
        raise InputError(f"--out is {str(out)!r}, but there is no folder {out.parent}")
    picture = out.with_name(f"{name}.map.png")
    for path in (out, picture):
        if path.exists() and not overwrite:
            raise InputError(f"{path}: exists already; choose another name or give --overwrite")
    return picture
