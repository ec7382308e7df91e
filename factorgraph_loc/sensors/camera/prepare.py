"""Preparation of a log's images before a run: features are computed, or the images are ignored."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.stream import FeatureStream, ImageStream
from factorgraph_loc.sensors.interfaces import PreparedLog, Use
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.settings import FrontendSettings
from factors.se2 import Array


def uses_images(sensors: Collection[str], modalities: Collection[str]) -> bool:
    """Whether an estimator with these ``modalities`` and ``sensors`` uses images."""
    return "camera" in sensors and "camera" in modalities


def frontend_of(rig: Rig, world: World) -> FrontendSettings:
    """The feature settings: those of the map's points, else those of the rig's camera.

    Without a map features are taken everywhere, since most of the strongest may be those of a thing that moves.
    """
    camera = rig.find(CameraSettings)
    settings = FrontendSettings() if camera is None else camera.frontend
    if world.points is None or not world.points.feature:
        return settings.model_copy(update={"everywhere": True})
    return settings.model_copy(update={"feature": world.points.feature})


def frames_of(log: Log) -> tuple[Array, Sequence[CameraFrame]]:
    """Timestamps (N,) and features of a log's images after feature detection; InputError if it has none."""
    stream = log.streams.get("camera")
    if not isinstance(stream, FeatureStream):
        raise InputError(f"{log.name}: has no images (camera), so there are no points to map")
    return stream.t + log.rig.time_offset("camera"), stream.frame


def prepare(use: Use, progress: Callable[[float], None]) -> PreparedLog:
    """Replace images by features if the run uses them, else by empty frames."""
    log, stream = use.log, use.log.streams.get("camera")
    if "camera" not in use.sensors or not isinstance(stream, ImageStream):
        return PreparedLog(log)
    if "camera" not in use.modalities:
        return _set_aside(log, stream, use.estimator)
    from factorgraph_loc.sensors.camera.frontend import with_features  # noqa: PLC0415 - runs without images need no OpenCV

    started = perf_counter()
    found, warnings = with_features(log, frontend_of(log.rig, log.world), progress)
    return PreparedLog(found, warnings, len(stream.t), perf_counter() - started)


def _set_aside(log: Log, stream: ImageStream, estimator: str) -> PreparedLog:
    """Frames without features; their timestamps still define the start and end of the run."""
    nothing = CameraFrame(
        0.0, "", np.empty((0, 2)), np.empty(0), np.empty((0, 0), dtype=np.uint8), np.empty(0, dtype=np.int64)
    )
    frames = FeatureStream(stream.t, [nothing] * len(stream.t))
    told = (f"{log.name}: {estimator} does not use images: all {len(stream.t)} are ignored",)
    by_name = estimator == "dead_reckoning"  # obvious from its name
    return PreparedLog(replace(log, streams={**log.streams, "camera": frames}), () if by_name else told)
