"""Plots of the camera: points of the map, images, and named points in them."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from factorgraph_loc.files.bounded import IMAGE, read_bytes
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.camera.measurement import PixelSightings
from factorgraph_loc.sensors.camera.stream import ImageStream, SightingStream
from factorgraph_loc.sensors.interfaces import Marks
from factorgraph_loc.vision.images import decoded
from factors.se2 import Array

JPEG_QUALITY = 90


def draw(log: Log) -> Marks:
    """The points of the map."""
    points = log.world.points
    positions = np.empty((0, 3)) if points is None else points.positions
    return Marks(
        "points", () if points is None else points.names, positions, marker=".", size=2.0, order=1.0, dense=True
    )


def has_pictures(log: Log) -> bool:
    """Whether the log has images or named points in images."""
    return "camera" in log.streams or "sightings" in log.streams


def images(log: Log) -> Iterator[tuple[float, bytes]]:
    """Time and JPEG of each image of the camera; InputError names one that cannot be read."""
    stream = log.streams.get("camera")
    if not isinstance(stream, ImageStream):
        return
    for t, file in zip((stream.t + log.rig.time_offset("camera")).tolist(), stream.file, strict=True):
        yield t, _jpeg(Path(file))


def sightings(log: Log) -> Iterator[tuple[float, tuple[str, ...], Array]]:
    """Time, names (K) and pixels (K, 2) of the named points in each image."""
    stream = log.streams.get("sightings")
    if not isinstance(stream, SightingStream):
        return
    for seen in stream.measurements(log.rig.time_offset("sightings")):
        assert isinstance(seen, PixelSightings)
        yield seen.t, seen.points, seen.pixels


def _jpeg(file: Path) -> bytes:
    content = read_bytes(file, IMAGE)
    if content.startswith(b"\xff\xd8"):
        return content
    picture = decoded(content, file, cv2.IMREAD_COLOR)
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])
