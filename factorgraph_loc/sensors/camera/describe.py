"""Descriptions of what a run can do with a camera."""

import math
from collections.abc import Callable, Container, Iterator, Sequence
from functools import partial

from factorgraph_loc.maps.common_error import CommonError
from factorgraph_loc.model.belief import Learnt
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.setup import MapUse, Setup
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.interfaces import Use
from factors.se2 import Array

NAMES = ("camera", "sightings")


def findable(log: Log, sensors: Sequence[str]) -> tuple[str, str] | None:
    """The kind of map elements that ``sensors`` could detect, and the message if none were detected."""
    if log.world.points is not None and any(name in sensors for name in NAMES):
        return "points", "no point of the map was found in an image"
    return None


def mappable(log: Log) -> str | None:
    """The map layer that can be made from a log's images, or None if there are none or the camera is unknown."""
    return "points" if "camera" in log.streams and log.rig.find(CameraSettings) is not None else None


def frame_error(setup: Setup, modalities: Container[str], landmarks: MapUse) -> Callable[[Array], Array] | None:
    """The covariances (N, 3, 3) at poses (N, 3) of what all points of the map that are seen from there have in common; None if it
    was made with a reference, or is not used."""
    points, camera = setup.world.points, setup.rig.find(CameraSettings)
    used = "camera" in setup.sensors and "camera" in modalities and landmarks != "unknown"
    if points is None or camera is None or not used:
        return None
    error, ahead = CommonError.of(points), camera.model().rotation[:, 2]
    return None if error is None else partial(error.at, looking=math.atan2(ahead[1], ahead[0]))


def doubts(use: Use, _diagnostics: Diagnostics, _learnt: Learnt) -> Iterator[str]:
    """A map without points that the camera could find, where the estimator needs them; a known map that was not wanted."""
    landmarks = getattr(use.settings, "landmarks", "known")
    if _has_points(use):
        if landmarks == "unknown" and not use.estimates_points:
            yield f"{use.log.name}: {use.estimator} does not estimate points: those of the map are used as they are"
    elif _looks(use) and not _follows(use) and not (use.estimates_points and landmarks != "known"):
        others = f", or {use.estimator}.landmarks=unknown" if use.estimates_points else ""
        yield f"{use.log.name}: the map has no points that a camera could find: give --world{others}"


def unmapped(use: Use) -> bool:
    """Whether the estimator can do without a map that has no points."""
    return use.estimates_points and _looks(use) and not _has_points(use) and not _follows(use)


def _looks(use: Use) -> bool:
    return "camera" in use.modalities and any(name in use.sensors for name in NAMES)


def _follows(use: Use) -> bool:
    """Whether features that are no points tell the motion."""
    return getattr(use.settings, "visual_odometry", False) is True


def _has_points(use: Use) -> bool:
    """Whether the camera is used, and the map has points that it could find."""
    points = use.log.world.points
    if points is None or not _looks(use):
        return False
    return bool(len(points) if "sightings" in use.sensors else len(points.owners))
