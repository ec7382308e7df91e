"""The commands ``fgloc calibrate``, which calibrates a rig, and ``fgloc map``, which makes a map of landmarks, tags or points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_loc.cli import completion, show
from factorgraph_loc.cli.options import (
    Json,
    LogName,
    LogNames,
    LogOptions,
    Overwrite,
    Prior,
    Settings,
    parse_settings,
    takes_options,
)
from factorgraph_loc.plugins import MAP_ESTIMATORS
from factorgraph_loc.text import number

COLUMNS = ("given x [m]", "y [m]", "learnt x [m]", "y [m]", "sigma [m]", "distance [m]", "verdict")


@takes_options
def calibrate(
    logs: LogNames,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="OUT.rig.toml", help="The rig to write; a report is written next to it."),
    ],
    *,
    source: LogOptions,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Calibrate a rig from logs, and write the rig and a report. Either all logs have reference poses, or none has.

    Example: fgloc calibrate monday.toml friday.toml -o cart.rig.toml
    """
    from factorgraph_loc.api import learning
    from factorgraph_loc.calibration import report

    page = learning.report_beside(out, overwrite=overwrite)  # checked before the logs are read, which is slow
    loaded = source.load(logs)
    show.first_use()
    with show.progress("calibrating", counted=True) as progress:
        result = learning.calibrate(loaded, out, overwrite=overwrite, progress=progress)
    show.warnings(result.doubts)
    if json:
        show.document(report.document(result) | {"files": {"rig": str(out), "report": str(page)}})
        return
    for line in report.summary(result):
        show.line(line)
    show.line(f"the rig is in {out}, the report in {page}")


@dataclass(frozen=True)
class MapArguments:
    """The options of ``fgloc map`` that :func:`factorgraph_loc.api.learning.build_map` has too, except the settings."""

    estimator: Annotated[
        str,
        typer.Option(
            "--estimator",
            "-e",
            metavar="NAME",
            help=f"One of {', '.join(MAP_ESTIMATORS)}.",
            autocompletion=completion.map_estimator,
        ),
    ] = MAP_ESTIMATORS[0]
    extend: Annotated[bool, typer.Option("--extend", help="Keep the log's map and add what it lacks.")] = False
    of: Annotated[
        str | None,
        typer.Option(
            metavar="WHAT",
            help="landmarks, tags or points. Default: points if the log has images, landmarks if it has sightings, else tags.",
        ),
    ] = None
    poses: Annotated[
        str | None,
        typer.Option(
            metavar="SOURCE",
            help="Robot poses for a map of tags: reference, or odometry to estimate them too. Default: a reference in the log.",
        ),
    ] = None
    height: Annotated[
        float | None,
        typer.Option(
            metavar="Z",
            help="Height [m] of tags or landmarks that the log's map lacks; by default that of the antennas or the radio.",
        ),
    ] = None
    drop_dead: Annotated[
        bool,
        typer.Option("--drop-dead", help="Map nothing; write the log's map without the tags that are believed dead."),
    ] = False
    prior: Prior = None
    overwrite: Overwrite = False


@takes_options
def map_(
    log: LogName,
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", metavar="OUT.world.toml", help="The map to write; a picture is written next to it."
        ),
    ],
    *,
    options: MapArguments,
    set_: Settings = None,
    source: LogOptions,
    json: Json = False,
) -> None:
    """Make a map of the landmarks, RFID tags or points in a log. Known landmarks and tags are compared with the log's map.

    Example: fgloc map monday.toml -o hall.world.toml
    """
    from factorgraph_loc.api import learning
    from factorgraph_loc.experiments import maps

    picture = maps.plot_path(out, overwrite=options.overwrite)  # checked before the log is read, which is slow
    loaded = source.load_one(log)
    settings = parse_settings(set_ or (), [options.estimator], [maps.POINTS])
    with show.progress("mapping", counted=False) as report:
        made = learning.build_map(
            loaded,
            out,
            settings=settings[options.estimator],
            points=settings[maps.POINTS],
            progress=lambda share: report(share, 1.0),
            **vars(options),
        )
    show.warnings(made.warnings)
    if json:
        files = {"map": str(out), "picture": str(picture)}
        show.document(document(made.details) | {"frame": made.frame, "files": files})
        return
    for line in (*print_elements(made.details), f"the frame of the new map is {made.frame}"):
        show.line(line)
    show.line()
    show.line(f"the map is in {out}, a picture of it in {picture}")


if TYPE_CHECKING:
    from factorgraph_loc.experiments.maps import DroppedTags
    from factorgraph_loc.mapping.mapping import LandmarkMap
    from factorgraph_loc.mapping.point_mapping import PointReport
    from factorgraph_loc.mapping.tag_mapping import MadeTags

    Made = LandmarkMap | MadeTags | PointReport | DroppedTags


def print_elements(made: Made) -> tuple[str, ...]:
    """Print a table of the landmarks or tags in the new map ``made``. Return lines to print below it.

    Points have no table."""
    from factorgraph_loc.experiments.maps import DroppedTags
    from factorgraph_loc.mapping.mapping import LandmarkMap
    from factorgraph_loc.mapping.tag_mapping import MadeTags

    if isinstance(made, DroppedTags):
        if made.dropped:
            _table(("dropped tag", "P(dead)"), [(name, f"{dead:.4f}") for name, dead in made.dropped.items()])
        count = len(made.dropped)
        return (f"believed dead and not in the new map: {count} of {count + made.kept} tags",)
    if isinstance(made, LandmarkMap):
        _table(("landmark", *COLUMNS), _rows(made, {}))
        return (made.summary(), *_notes(made))
    if isinstance(made, MadeTags):
        _table(("tag", *COLUMNS), _rows(made.made, _reasons(made)))
        return (made.made.summary("tags"), *_notes_on_tags(made))
    return (
        f"{made.points} points are in the new map, with {made.observations} observations in {made.keyframes} keyframes"
        + (f", {made.fused} of them from the log's map" if made.fused else ""),
        f"reprojection residual: {made.rms:.2f} px root mean square, {made.mad:.2f} px median",
        f"parallax {made.parallax:.3f} rad, standard deviation in the worst direction {made.sigma:.3f} m (medians)",
        f"the adjustment moved the cameras by {made.shifted:.3f} m and {made.turned:.4f} rad (medians)",
    )


def document(made: Made) -> dict[str, Any]:
    """Return the dictionary that ``--json`` prints for the new map ``made``: its elements, a summary and notes."""
    from factorgraph_loc.mapping.mapping import LandmarkMap
    from factorgraph_loc.mapping.tag_mapping import MadeTags

    if isinstance(made, LandmarkMap):
        landmarks = [{"landmark": name} | entry for name, entry in _entries(made, {}).items()]
        return {"landmarks": landmarks, "summary": made.summary(), "notes": _notes(made)}
    if not isinstance(made, MadeTags):
        return asdict(made)
    facing = {name: tag.facing for name, tag in made.world.tags.items()}
    entries = _entries(made.made, _reasons(made))
    modes = {
        name: [{"weight": m.weight, "position": m.position.tolist()} for m in modes]
        for name, modes in made.modes.items()
    }
    return {
        "tags": [{"tag": name, "facing": facing.get(name)} | entry for name, entry in entries.items()],
        "not_located": _reasons(made),
        "modes": modes,
        "rms": math.nan if made.rms is None else made.rms,
        "summary": made.made.summary("tags"),
        "notes": _notes_on_tags(made),
    }


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    show.table(header, rows)
    show.line()


def _rows(made: LandmarkMap, verdicts: Mapping[str, str]) -> list[tuple[str, ...]]:
    rows = []
    for name, entry in _entries(made, verdicts).items():
        places = (*(entry["given"] or (None, None)), *(entry["learnt"] or (None, None)))
        numbers = (number(value, 3) for value in (*places, entry["sigma"], entry["distance"]))
        rows.append((name, *numbers, entry["verdict"]))
    return rows


def _entries(made: LandmarkMap, verdicts: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Return {name: values} of the landmarks or tags in a new map, such as the given and the estimated position.

    "verdict" is the result of comparing the two positions. ``verdicts``: for some names, texts that replace it."""
    return {
        entry.landmark: {
            "given": None if entry.given is None else entry.given.tolist(),
            "learnt": None if entry.learnt is None else entry.learnt.position.tolist(),
            "covariance": None if entry.learnt is None else entry.learnt.covariance.tolist(),
            "sigma": entry.sigma,
            "distance": entry.distance,
            "verdict": verdicts.get(entry.landmark, entry.verdict),
            "flagged": entry.flagged,
        }
        for entry in made.entries
    }


def _reasons(made: MadeTags) -> dict[str, str]:
    """Return {name: reason} of the tags that could not be located."""
    return {name: str(why) for name, why in made.open.items()}


def _notes(made: LandmarkMap) -> list[str]:
    """Return lines to print below the table: notes, and landmarks of the given map that were not observed."""
    unseen = ", ".join(made.unseen)
    return [*map(str, made.notes), *([f"not observed, kept from the given map: {unseen}"] if unseen else [])]


def _notes_on_tags(made: MadeTags) -> list[str]:
    """Return lines to print below the table of tags: notes, tags without a position, distances from given positions."""
    listed = {entry.landmark for entry in made.made.entries}
    unmapped = {name: why for name, why in made.open.items() if name not in listed}
    lines = [*map(str, made.made.notes)]
    kept = [name for name in made.open if name in made.world.tags]
    if kept:
        lines.append(f"not located, kept from the given map: {', '.join(kept)}")
    silent = [name for name, why in made.open.items() if why.kind == "unread"]
    if silent:
        lines.append(f"never read: {', '.join(silent)}")
    if made.rms is not None:
        lines.append(f"root mean square distance from the given positions: {made.rms:.3f} m")
    chance = [name for name, why in unmapped.items() if why.kind == "chance"]
    if chance:
        lines.append(
            f"{len(chance)} tags are neither in the given nor in the new map, because they were read too rarely to be located"
        )
    return lines + [f"not in the map: {name}, {why}" for name, why in unmapped.items() if name not in chance]
