"""Prepares a run with a camera: checks the settings, and replaces images by features."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import TURN, Measurement
from factorgraph_loc.model.measurement import named as name_of
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.measurement import CAMERAS, CameraImage, FeatureStream, ImageStream
from factorgraph_loc.sensors.camera.settings import CameraSettings, FrontendSettings
from factorgraph_loc.sensors.interfaces import Ending, Review, Use
from factorgraph_loc.sensors.registry import moving
from factorgraph_loc.sensors.tables import Intake
from factorgraph_loc.text import Notice, notice, plain
from factorgraph_loc.vision.frame import CameraFrame
from factors.se2 import Array

if TYPE_CHECKING:
    from factorgraph_loc.sensors.camera.frontend import LiveFrontend


def check(use: Use) -> Use:
    """Return a copy of the run ``use`` that estimates points if the map has no points for the camera, or ``use``
    itself.

    The copy has the setting ``landmarks`` = "unknown" and a warning. ``use`` is returned if the user has set
    ``landmarks``, or if the estimator cannot estimate points. It is also returned if the run has other exteroceptive
    sensors.
    """
    motion = moving(use.sensors, TURN)
    unmapped = use.estimates_points and _uses_camera(use) and not _has_points(use)
    if "landmarks" in use.given or not unmapped or any(name not in (*CAMERAS, *motion) for name in use.sensors):
        return use
    settings = use.settings.model_copy(update={"landmarks": "unknown"})
    sentence = "{log}: the map has no points for the camera: points are estimated ({estimator}.landmarks=unknown)"
    warning = notice("map_estimated", sentence, use.log.name, use.estimator)
    return replace(use, settings=settings, warnings=(*use.warnings, warning))


def review(use: Use, _ending: Ending) -> Review:
    """Return warnings if the points of the map cannot be used as the settings of the run require."""
    return Review(tuple(_doubts(use)))


def _doubts(use: Use) -> Iterator[Notice]:
    """Yield a warning if the run needs points and the map has none. Yield a warning if the settings require that points
    are estimated, but the estimator cannot estimate points."""
    landmarks = getattr(use.settings, "landmarks", "known")
    if _has_points(use):
        if landmarks == "unknown" and not use.estimates_points:
            sentence = "{log}: {estimator} cannot estimate points: the points of the map are used unchanged"
            yield notice("fixed_points", sentence, use.log.name, use.estimator)
    elif _uses_camera(use) and not (use.estimates_points and landmarks != "known"):
        alternative = f", or {use.estimator}.landmarks=unknown" if use.estimates_points else ""
        sentence = "{log}: the map has no points for the camera: give a map with --world{alternative}"
        yield notice("no_points", sentence, use.log.name, alternative)


def _uses_camera(use: Use) -> bool:
    return "camera" in use.modalities and any(name in use.sensors for name in CAMERAS)


def _has_points(use: Use) -> bool:
    """Return True if the run uses the camera and the map has points that the camera can identify."""
    points = use.log.world.points
    if points is None or not _uses_camera(use):
        return False
    return bool(len(points) if "sightings" in use.sensors else len(points.owners))


@dataclass(frozen=True)
class PreparedLog:
    """A log with features instead of images. ``images``: the number of images with feature detection. ``seconds``: the
    duration of feature detection. Both are 0 if no features were needed."""

    log: Log
    warnings: tuple[Notice, ...] = ()
    images: int = 0
    seconds: float = 0.0


def frontend_of(rig: Rig, world: World) -> FrontendSettings:
    """Return the settings of feature detection in ``rig``, with the kind of feature of the points in the map ``world``.
    If the map has no points, features are distributed over the image, because the strongest may be on a moving
    object."""
    camera = rig.find(CameraSettings)
    settings = FrontendSettings() if camera is None else camera.frontend
    if world.points is None or not world.points.feature:
        return settings.model_copy(update={"everywhere": True})
    return settings.model_copy(update={"feature": world.points.feature})


def frames_of(log: Log) -> tuple[Array, Sequence[CameraFrame]]:
    """Return the timestamps (N,) [s] and the features of the N images of a log. Raises InputError if the log has no
    images, or if their features are not detected yet."""
    stream = log.streams.get("camera")
    if not isinstance(stream, FeatureStream):
        raise InputError(f"{log.name}: has no images (camera), so there are no points to map")
    return stream.t + log.rig.time_offset("camera"), stream.frame


def prepare(use: Use, progress: Callable[[float], None]) -> PreparedLog:
    """Return the log of the run ``use`` with features instead of images. If the estimator does not use images, no
    features are detected. ``progress`` is called with the completed fraction."""
    log, stream = use.log, use.log.streams.get("camera")
    if "camera" not in use.sensors or not isinstance(stream, ImageStream):
        return PreparedLog(log)
    if "camera" not in use.modalities:
        return _without_features(log, stream, use.estimator)
    from factorgraph_loc.sensors.camera.frontend import with_features  # noqa: PLC0415 - runs without images need no OpenCV

    started = perf_counter()
    replaced, warnings = with_features(log, frontend_of(log.rig, log.world), progress)
    return PreparedLog(replaced, warnings, len(stream.t), perf_counter() - started)


def _without_features(log: Log, stream: ImageStream, estimator: str) -> PreparedLog:
    """Return the log with an empty list of features for each image, and a warning that ``estimator`` ignores images.
    ``stream``: the images of the log."""
    nothing = CameraFrame(0.0, "", np.empty((0, 2)), np.empty((0, 0), dtype=np.uint8), np.empty(0, dtype=np.int64))
    frames = FeatureStream(stream.t, [nothing] * len(stream.t))
    sentence = "{log}: {estimator} does not use images: all {images} are ignored"
    warning = (notice("unused_images", sentence, log.name, estimator, len(stream.t)),)
    is_obvious = estimator == "dead_reckoning"  # no warning, because dead reckoning uses only odometry
    return PreparedLog(replace(log, streams={**log.streams, "camera": frames}), () if is_obvious else warning)


class CameraIntake(Intake):
    """Detects features in images for the live localizer. Raises InputError if the length of descriptors differs from
    the map. If the map has no descriptors, the length must be that of the first image."""

    def __init__(self, rig: Rig, world: World) -> None:
        points = world.points
        self._rig, self._world = rig, world
        self._frontend: LiveFrontend | None = None
        self._lock = threading.Lock()
        self._known = {} if points is None or not points.feature else {points.feature: points.descriptors.shape[1]}

    def measured(self, m: Measurement) -> Measurement:
        if not isinstance(m, CameraImage):
            return m
        from factorgraph_loc.sensors.camera.frontend import LiveFrontend  # noqa: PLC0415 - OpenCV, for images only

        with self._lock:
            if self._frontend is None:
                settings = frontend_of(self._rig, self._world)
                self._frontend = LiveFrontend(settings, self._rig.of(CameraSettings).model())
            return self._frontend.frame(m.t, m.pixels)

    def require(self, m: Measurement) -> None:
        if not isinstance(m, CameraFrame) or not len(m.pixels):
            return
        width = m.descriptors.shape[1]
        if width != self._known.setdefault(m.feature, width) or not width:
            expected = f"{self._known[m.feature]} numbers each, as in earlier {plain(m.feature)}"
            raise bad_field(name_of(m), "length of descriptors", width, expected)
