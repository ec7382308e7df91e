"""What is done with a log's images before an estimator runs: their features are found, or they are set aside."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from factorgraph_loc.errors import FglocError
from factorgraph_loc.fusion import registry
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.stream import FeatureStream, ImageStream
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.settings import FrontendSettings

CAMERA = "camera"
OF_CAMERA = (CAMERA, "sightings")  # sensors that mean nothing without a camera in the rig


@dataclass(frozen=True)
class Prepared:
    """A ``log`` that can be run: no images are left in it that are used. ``images``: of how many the features were found or
    taken from the cache, in ``seconds``."""

    log: Log
    warnings: tuple[str, ...] = ()
    images: int = 0
    seconds: float = 0.0


def takes_pixels(estimator: str) -> bool:
    """Whether an estimator, by its name, uses what a camera sees."""
    return CAMERA in getattr(registry.estimator_type(estimator), "modalities", ())


def frontend_of(log: Log) -> FrontendSettings:
    """What is looked for in the images of a log."""
    return frontend_for(log.rig, log.world)


def frontend_for(rig: Rig, world: World) -> FrontendSettings:
    """What is looked for in images: what the map's points look like in them, else what the rig's camera says."""
    settings = rig.camera.frontend if rig.camera is not None else FrontendSettings()
    points = world.points
    if points is None or not points.feature or points.feature == settings.feature:
        return settings
    return FrontendSettings.model_validate(settings.model_dump() | {"feature": points.feature})


def prepare(
    log: Log, sensors: Iterable[str], estimator: str, progress: Callable[[float], None] | None = None
) -> Prepared:
    """The log with features in place of images, if ``sensors`` has them; an estimator that takes none is given empty frames."""
    stream = log.streams.get(CAMERA)
    if CAMERA not in sensors or not isinstance(stream, ImageStream):
        return Prepared(log)
    if not takes_pixels(estimator):
        return Prepared(_set_aside(log, stream), _said(log, stream, estimator))
    from factorgraph_loc.sensors.camera.frontend import with_features  # noqa: PLC0415 - runs without images need no OpenCV

    started = perf_counter()
    found, warnings = with_features(log, frontend_of(log), progress)
    return Prepared(found, warnings, len(stream.t), perf_counter() - started)


def fill_cache(log: Log) -> None:
    """Find the features of a log's images, so that runs of it in several processes find them in the cache.

    What is wrong with the log is for the runs to tell.
    """
    if isinstance(log.streams.get(CAMERA), ImageStream) and log.rig.camera is not None:
        from factorgraph_loc.sensors.camera.frontend import with_features  # noqa: PLC0415

        try:
            with_features(log, frontend_of(log))
        except FglocError:
            return


def _set_aside(log: Log, stream: ImageStream) -> Log:
    """Frames without features: their stamps still count for when the run begins and ends."""
    nothing = CameraFrame(
        0.0, "", np.empty((0, 2)), np.empty(0), np.empty((0, 0), dtype=np.uint8), np.empty(0, dtype=np.int64)
    )
    frames = FeatureStream(stream.t, [nothing] * len(stream.t))
    return replace(log, streams=dict(log.streams) | {CAMERA: frames})


def _said(log: Log, stream: ImageStream, estimator: str) -> tuple[str, ...]:
    if estimator == "dead_reckoning":  # which says so by its name
        return ()
    return (f"{log.name}: {estimator} takes no images: all {len(stream.t)} are ignored",)
