"""Descriptions of what a run can do with a camera."""

from collections.abc import Iterator
from dataclasses import replace

from factorgraph_loc.model.measurement import TURN
from factorgraph_loc.sensors.interfaces import Ending, Review, Use
from factorgraph_loc.sensors.registry import moving

NAMES = ("camera", "sightings")


def check(use: Use) -> Use:
    """The run, with points estimated where the map has none and no other sensor needs a map, unless the user's settings say what is
    done."""
    motion = moving(use.sensors, TURN)
    unmapped = use.estimates_points and _looks(use) and not _has_points(use) and not _follows(use)
    if "landmarks" in use.given or not unmapped or any(name not in (*NAMES, *motion) for name in use.sensors):
        return use
    settings = use.settings.model_copy(update={"landmarks": "unknown"})
    told = f"the map has nothing that the camera could find: it is estimated ({use.estimator}.landmarks=unknown)"
    return replace(use, settings=settings, warnings=(*use.warnings, f"{use.log.name}: {told}"))


def review(use: Use, _ending: Ending) -> Review:
    """The warnings of a run."""
    return Review(tuple(_doubts(use)))


def _doubts(use: Use) -> Iterator[str]:
    """A map without points that the camera could find, where the estimator needs them; a known map that was not wanted."""
    landmarks = getattr(use.settings, "landmarks", "known")
    if _has_points(use):
        if landmarks == "unknown" and not use.estimates_points:
            yield f"{use.log.name}: {use.estimator} does not estimate points: those of the map are used as they are"
    elif _looks(use) and not _follows(use) and not (use.estimates_points and landmarks != "known"):
        others = f", or {use.estimator}.landmarks=unknown" if use.estimates_points else ""
        yield f"{use.log.name}: the map has no points that a camera could find: give --world{others}"


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
