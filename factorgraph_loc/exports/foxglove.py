"""Export of a log and its runs as an MCAP file (https://mcap.dev) for Foxglove: poses, covariances, paths, tags, landmarks,
images.

Messages are JSON, stamped with the absolute time of the log. Frames: ``world``, and one per run, named after it, for the
robot's estimated pose. The library ``mcap`` is optional and imported only where it is used.
"""

import base64
import heapq
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.exports import scene
from factorgraph_loc.exports.foxglove_schemas import OTHERS, SCHEMAS
from factorgraph_loc.exports.runs import StoredRun
from factorgraph_loc.exports.scene import DARK, LIT, SEEN, Colour, colours
from factorgraph_loc.files.models import replacing
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.camera import draw
from factors.se2 import Array

WORLD = "world"
MARK, THIN = 0.12, 0.02  # m: the diameter of a tag or landmark, the width of a line
LETTERS = 0.15  # m
STRIP, LIST = 0, 2  # line types: connected, or pairs of points
POINTS = 1  # annotation type
INFO = 2  # level of an event


@dataclass(frozen=True)
class Message:
    """A message to be written, with its time ``t`` [s] of the log."""

    t: float
    topic: str
    schema: str
    content: dict[str, Any]


def write_mcap(log: Log, runs: Sequence[StoredRun], path: Path) -> None:
    """Write an MCAP file.

    Topics: ``/map``, ``/tags``, ``/landmarks`` (those being read or sighted), ``/reference/pose`` and ``/reference/path``,
    ``/camera/image`` and ``/camera/landmarks``; for each run ``/NAME/pose``, ``/NAME/transform``, ``/NAME/path`` (of the final
    trajectory), ``/NAME/ellipse``, ``/NAME/estimate`` (values for plots, with the covariance (3, 3) of x, y, heading by rows),
    ``/NAME/landmarks`` (learnt ones) and ``/NAME/events``.

    Raises InputError if ``mcap`` is not installed or an image cannot be read.
    """
    try:
        from mcap.writer import Writer  # noqa: PLC0415 - an optional library
    except ImportError as error:
        raise InputError("writing .mcap needs mcap: pip install 'factorgraph-loc[foxglove]'") from error
    start = _start(log, runs)
    zero_ns = max(log.t0_ns, math.ceil(-start) * 10**9)  # the format has no times before 1970
    with writing(path), replacing(path) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start(library="fgloc")
        writer.add_metadata("log", {"name": log.name, **{key: str(value) for key, value in log.metadata.items()}})
        schemas = {
            s["title"]: writer.register_schema(s["title"], "jsonschema", json.dumps(s).encode()) for s in SCHEMAS
        }
        channels: dict[str, int] = {}
        for message in heapq.merge(*_streams(log, runs, start), key=lambda m: m.t):
            if message.topic not in channels:
                channels[message.topic] = writer.register_channel(message.topic, "json", schemas[message.schema])
            ns = zero_ns + round(message.t * 1e9)
            try:
                data = json.dumps(_stamped(message.content, ns), separators=(",", ":"), allow_nan=False).encode()
            except ValueError as error:
                where = f"{message.topic} at {message.t:.3f} s"
                raise InputError(f"{path}: {where} has a value that is not finite") from error
            writer.add_message(channels[message.topic], log_time=ns, publish_time=ns, data=data)
        writer.finish()  # type: ignore[no-untyped-call]


def _start(log: Log, runs: Sequence[StoredRun]) -> float:
    """The earliest time [s] of anything exported."""
    stamps = [run_t for run in runs for run_t in (run.causal.t, run.final.t)]
    if log.reference is not None:
        stamps.append(log.reference.t)
    return min(
        [log.span()[0] - 1.0, *(float(t[0]) for t in stamps if len(t))]
    )  # the age of a read at the end of its round


def _stamped(content: Mapping[str, Any], ns: int) -> dict[str, Any]:
    """A message with the timestamp set in all its parts."""
    stamp = {"sec": ns // 10**9, "nsec": ns % 10**9}
    parts = {
        key: [{"timestamp": stamp, **part} for part in content[key]]
        for key in ("entities", "points", "texts")
        if key in content
    }
    return {**content, **parts} if parts else {"timestamp": stamp, **content}


def _streams(log: Log, runs: Sequence[StoredRun], start: float) -> Iterator[Iterator[Message]]:
    """All messages, as streams ordered by time."""
    yield iter([Message(start, "/map", "foxglove.SceneUpdate", _map(log))])
    for marks, positions, lights in scene.layers(log):
        yield _lamps(f"/{marks.layer}", positions, lights)
    yield _images(log)
    yield _sightings(log)
    if log.reference is not None:
        yield iter([_path("/reference", log.reference, start)])
        yield _poses("/reference", log.reference)
    for run, colour in zip(runs, colours(), strict=False):
        at = f"/{run.name}"
        yield iter([_path(at, run.final, start), _learnt(run, colour, start)])
        yield _poses(at, run.played())
        yield _transforms(run)
        yield _ellipses(run, colour)
        yield _estimates(run)
        yield _events(run)


def _map(log: Log) -> dict[str, Any]:
    walls = np.array(log.world.walls).reshape(-1, 2)
    entities = [_entity("walls", lines=[_line(walls, DARK, LIST)])] if len(walls) else []
    for marks, positions, _ in scene.layers(log):
        if positions and not marks.dense:
            entities.append(_entity(marks.layer, **_marks(positions, DARK, MARK)))
    return _update(entities)


def _lamps(topic: str, positions: Mapping[str, Array], lights: scene.Lights) -> Iterator[Message]:
    for t, names in zip(lights.t.tolist(), lights.names, strict=True):
        lit = {name: positions[name] for name in names if name in positions}
        yield Message(t, topic, "foxglove.SceneUpdate", _update([_entity("lit", **_marks(lit, LIT, 2.0 * MARK))]))


def _poses(at: str, trajectory: Trajectory) -> Iterator[Message]:
    for t, pose in zip(trajectory.t.tolist(), _places(trajectory), strict=True):
        yield Message(t, f"{at}/pose", "foxglove.PoseInFrame", {"frame_id": WORLD, "pose": pose})


def _path(at: str, trajectory: Trajectory, start: float) -> Message:
    return Message(start, f"{at}/path", "foxglove.PosesInFrame", {"frame_id": WORLD, "poses": _places(trajectory)})


def _places(trajectory: Trajectory) -> list[dict[str, Any]]:
    """The poses, with identity rotation where the heading is undefined."""
    known = np.array((1.0, 1.0, float(trajectory.has_heading)))
    return [_pose(*pose) for pose in np.where(known, trajectory.poses, 0.0).tolist()]


def _transforms(run: StoredRun) -> Iterator[Message]:
    for t, pose in zip(run.played().t.tolist(), run.played().poses.tolist(), strict=True):
        place = _pose(*pose)
        content = {"translation": place["position"], "rotation": place["orientation"]}
        frames = {"parent_frame_id": WORLD, "child_frame_id": run.name}
        yield Message(t, f"/{run.name}/transform", "foxglove.FrameTransform", frames | content)


def _ellipses(run: StoredRun, colour: Colour) -> Iterator[Message]:
    t, outlines = scene.ellipses(run.played())
    for at, outline in zip(t.tolist(), outlines, strict=True):
        entity = _entity("ellipse", lines=[_line(outline, colour, STRIP)])
        yield Message(at, f"/{run.name}/ellipse", "foxglove.SceneUpdate", _update([entity]))


def _estimates(run: StoredRun) -> Iterator[Message]:
    known = {name: dict(zip(t.tolist(), values.tolist(), strict=True)) for name, (t, values) in run.series.items()}
    trajectory = run.played()
    covariances = trajectory.covariances
    for i, t in enumerate(trajectory.t.tolist()):
        content = dict(zip(("x", "y", "heading"), trajectory.poses[i].tolist(), strict=True))
        if covariances is not None and np.isfinite(covariances[i]).all():
            c = covariances[i]
            content["covariance"] = c.ravel().tolist()
            content["sigma_position"] = math.sqrt(max(c[0, 0] + c[1, 1], 0.0))
            content["sigma_heading"] = math.sqrt(max(c[2, 2], 0.0))
        content |= {name: values[t] for name, values in known.items() if t in values}
        yield Message(t, f"/{run.name}/estimate", "fgloc.Estimate", content)


def _events(run: StoredRun) -> Iterator[Message]:
    for t, text in sorted(run.events):
        content = {"level": INFO, "message": text, "name": run.name, "file": "", "line": 0}
        yield Message(t, f"/{run.name}/events", "foxglove.Log", content)


def _learnt(run: StoredRun, colour: Colour, start: float) -> Message:
    positions = {name: np.array((*point.position, 0.0)) for name, point in run.landmarks.items()}
    known = [p for p in run.landmarks.values() if np.isfinite(p.covariance).all()]
    outlines = scene.outlines(
        np.array([p.position for p in known]).reshape(-1, 2), np.array([p.covariance for p in known]).reshape(-1, 2, 2)
    )
    entity = _entity("learnt", lines=[_line(o, colour, STRIP) for o in outlines], **_marks(positions, colour, MARK))
    return Message(start, f"/{run.name}/landmarks", "foxglove.SceneUpdate", _update([entity]))


def _images(log: Log) -> Iterator[Message]:
    for t, jpeg in draw.images(log):
        content = {"frame_id": "camera", "data": base64.b64encode(jpeg).decode(), "format": "jpeg"}
        yield Message(t, "/camera/image", "foxglove.CompressedImage", content)


def _sightings(log: Log) -> Iterator[Message]:
    for t, names, pixels in draw.sightings(log):
        places = [{"x": u, "y": v} for u, v in pixels.tolist()]
        colour = _colour(SEEN)
        points = {
            "type": POINTS,
            "points": places,
            "outline_color": colour,
            "outline_colors": [],
            "fill_color": colour,
            "thickness": 4.0,
        }
        texts = [
            {
                "position": at,
                "text": name,
                "font_size": 12.0,
                "text_color": colour,
                "background_color": _colour((0, 0, 0), 0.3),
            }
            for at, name in zip(places, names, strict=True)
        ]
        content = {"circles": [], "points": [points], "texts": texts}
        yield Message(t, "/camera/landmarks", "foxglove.ImageAnnotations", content)


def _update(entities: list[dict[str, Any]]) -> dict[str, Any]:
    return {"deletions": [], "entities": entities}


def _entity(name: str, **shapes: list[dict[str, Any]]) -> dict[str, Any]:
    empty: dict[str, Any] = {key: [] for key in ("metadata", "spheres", "lines", "texts", *OTHERS)}
    about = {"frame_id": WORLD, "id": name, "lifetime": {"sec": 0, "nsec": 0}, "frame_locked": False}
    return about | empty | shapes


def _marks(positions: Mapping[str, Array], colour: Colour, size: float) -> dict[str, list[dict[str, Any]]]:
    """A sphere and a text label at each position (3,)."""
    spheres, texts = [], []
    for name, (x, y, z) in ((name, p.tolist()) for name, p in positions.items()):
        spheres.append(
            {"pose": _pose(x, y, 0.0, z), "size": {"x": size, "y": size, "z": size}, "color": _colour(colour)}
        )
        texts.append(
            {
                "pose": _pose(x, y, 0.0, z + size),
                "billboard": True,
                "font_size": LETTERS,
                "scale_invariant": False,
                "color": _colour(colour),
                "text": name,
            }
        )
    return {"spheres": spheres, "texts": texts}


def _line(points: Array, colour: Colour, kind: int) -> dict[str, Any]:
    """A line on the floor through ``points`` (K, 2)."""
    return {
        "type": kind,
        "pose": _pose(0.0, 0.0, 0.0),
        "thickness": THIN,
        "scale_invariant": False,
        "points": [{"x": x, "y": y, "z": 0.0} for x, y in np.round(points, 4).tolist()],
        "color": _colour(colour),
        "colors": [],
        "indices": [],
    }


def _pose(x: float, y: float, heading: float, z: float = 0.0) -> dict[str, Any]:
    turn = {"x": 0.0, "y": 0.0, "z": math.sin(heading / 2.0), "w": math.cos(heading / 2.0)}
    return {"position": {"x": x, "y": y, "z": z}, "orientation": turn}


def _colour(colour: Colour, opacity: float = 1.0) -> dict[str, float]:
    red, green, blue = (value / 255.0 for value in colour)
    return {"r": red, "g": green, "b": blue, "a": opacity}
