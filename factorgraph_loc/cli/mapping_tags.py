"""``fgloc map`` of RFID tags."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.errors import InputError

if TYPE_CHECKING:
    from factorgraph_loc.calibration.tag_mapping import MadeTags
    from factorgraph_loc.estimators.base import PosePrior
    from factorgraph_loc.log import Log

HEADER = ("tag", "given x [m]", "y [m]", "learnt x [m]", "y [m]", "sigma [m]", "distance [m]", "verdict")
HEIGHTS = (-10.0, 20.0)  # m


@dataclass(frozen=True)
class TagOptions:
    """The options of the command that tags take."""

    poses: str | None
    prior: str | None
    height: float | None
    extend: bool
    json: bool


def map_log(log: Log, options: TagOptions, out: Path, picture: Path) -> None:
    """Make the map of a log's tags, write it and its picture, and say what was found."""
    from factorgraph_loc.calibration import tag_mapping
    from factorgraph_loc.calibration.map_figure import tag_figure
    from factorgraph_loc.evaluation.figures import save
    from factorgraph_loc.files import replacing
    from factorgraph_loc.world import write_world

    poses = _poses(log, options)
    if options.height is not None and not HEIGHTS[0] <= options.height <= HEIGHTS[1]:
        raise InputError(f"--tag-height is {options.height:g}, expected metres, {HEIGHTS[0]:g} to {HEIGHTS[1]:g}")
    if options.extend and not log.world.tags:
        raise InputError(f"{log.name}: has no map of tags that could be extended; leave --extend out")
    prior, frame = (None, "that of the reference") if poses == "reference" else _prior(log, options)
    with show.progress("tags", counted=False) as report:
        made = tag_mapping.map_tags(
            log,
            poses,
            prior,
            extend=options.extend,
            height=options.height,
            progress=lambda share: report(share, 1.0),
        )
    if options.extend or (poses == "odometry" and made.made.judged):
        frame = "that of the given map"
    try:
        with replacing(picture) as temporary:
            save(tag_figure(log.name, made), temporary)
        write_world(made.world, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    for warning in log.warnings:
        show.note(f"warning: {warning}")
    if options.json:
        show.document(_document(made, frame) | {"files": {"map": str(out), "picture": str(picture)}})
        return
    show.table(HEADER, _rows(made))
    typer.echo()
    for line in (made.made.summary("tags"), *_notes(made), f"the frame of the new map is {frame}"):
        typer.echo(line)
    typer.echo(f"\nthe map is in {out}, a picture of it in {picture}")


def _poses(log: Log, options: TagOptions) -> Literal["reference", "odometry"]:
    if options.poses is None:
        return "odometry" if log.reference is None else "reference"
    if options.poses == "reference":
        return "reference"
    if options.poses == "odometry":
        return "odometry"
    raise InputError(f"--poses is {options.poses!r}, expected reference or odometry")


def _prior(log: Log, options: TagOptions) -> tuple[PosePrior | None, str]:
    """Where the robot starts, and the frame in words. Without a map in use the start is certain, as it defines the frame."""
    from dataclasses import replace

    import numpy as np

    from factorgraph_loc.calibration.tag_mapping import START_SIGMA
    from factorgraph_loc.experiments.prior import resolve_prior

    prior, source = resolve_prior(log, options.prior)
    if prior is None:
        if options.extend:
            raise InputError(
                f"{log.name}: to extend its map from odometry the start has to be known in it; give --prior"
            )
        return None, "that of the start: the first pose is the origin (0, 0, 0)"
    x, y, heading = prior.pose
    said = {"log": "the log's start", "reference": "its reference"}.get(source, "--prior")
    frame = f"that of the start: the robot starts at ({x:.3f} m, {y:.3f} m, {heading:.3f} rad), from {said}"
    return (prior if options.extend else replace(prior, covariance=START_SIGMA**2 * np.eye(3))), frame


def _rows(made: MadeTags) -> list[tuple[str, ...]]:
    rows = []
    for entry in made.made.entries:
        given = (None, None) if entry.given is None else entry.given
        learnt = (None, None) if entry.learnt is None else entry.learnt.position
        numbers = (*given, *learnt, entry.sigma, entry.distance)
        verdict = made.open.get(entry.landmark, entry.verdict)
        rows.append((entry.landmark, *(show.number(value) for value in numbers), verdict))
    return rows


def _notes(made: MadeTags) -> list[str]:
    """What the table does not tell: the tags that are in no map, and how far the others are off."""
    listed = {entry.landmark for entry in made.made.entries}
    others = {name: why for name, why in made.open.items() if name not in listed}
    notes = [note for note in made.made.notes if not note.startswith("kept as they are")]
    kept = [name for name in made.open if name in made.world.tags]
    if kept:
        notes.append(f"kept as they are in the given map, as they could not be located: {', '.join(kept)}")
    silent = [name for name, why in made.open.items() if why == "never read"]
    if silent:
        notes.append(f"never read: {', '.join(silent)}")
    if made.rms is not None:
        notes.append(f"root mean square distance from the given places: {made.rms:.3f} m")
    chance = [name for name, why in others.items() if "than chance" in why]
    if chance:
        notes.append(
            f"{len(chance)} tags that the map lacks were read so seldom that no place explains it better than chance"
        )
    return notes + [f"not in the map: {name}, {why}" for name, why in others.items() if name not in chance]


def _document(made: MadeTags, frame: str) -> dict[str, Any]:
    tags = []
    for entry in made.made.entries:
        written = made.world.tags.get(entry.landmark)
        tags.append(
            {
                "tag": entry.landmark,
                "given": None if entry.given is None else entry.given.tolist(),
                "learnt": None if entry.learnt is None else entry.learnt.position.tolist(),
                "covariance": None if entry.learnt is None else entry.learnt.covariance.tolist(),
                "facing": None if written is None else written.facing,
                "sigma": entry.sigma,
                "distance": entry.distance,
                "verdict": made.open.get(entry.landmark, entry.verdict),
                "flagged": entry.flagged,
            }
        )
    modes = {
        name: [{"weight": m.weight, "position": m.position.tolist()} for m in modes]
        for name, modes in made.modes.items()
    }
    return {
        "tags": tags,
        "not_located": dict(made.open),
        "modes": modes,
        "rms": math.nan if made.rms is None else made.rms,
        "summary": made.made.summary("tags"),
        "notes": _notes(made),
        "frame": frame,
    }
