"""What a run says of itself where the map and what was measured do not come together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.metrics import FEWEST_SCORED
from factorgraph_loc.evaluation.pairing import pairs
from factorgraph_loc.experiments.images import CAMERA, OF_CAMERA
from factorgraph_loc.files.models import FileModel
from factorgraph_loc.fusion.base import Estimator
from factorgraph_loc.model.belief import PoseEstimate
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.landmarks.stream import BearingRangeStream
from factorgraph_loc.sensors.rfid.stream import RfidStream

MOSTLY = 0.9  # of the time with estimates
SHOWN = 5  # names in a warning


def partly_scored(log: Log, final: Trajectory, max_gap: float) -> tuple[str, ...]:
    """A reference with too few poses to score by, or that is there for a part of the time."""
    reference = log.reference
    if reference is None or not len(reference) or not len(final):
        return ()
    count = int(np.sum(np.isfinite(pairs(final, reference, max_gap).poses[:, 0])))
    if count < FEWEST_SCORED:
        return (
            f"{log.name}: only {count} poses of the reference have an estimate, expected at least {FEWEST_SCORED}: "
            "nothing is scored",
        )
    begin, end = max(reference.t[0], final.t[0]), min(reference.t[-1], final.t[-1])
    whole = final.t[-1] - final.t[0]
    if end - begin >= MOSTLY * whole:
        return ()
    return (
        f"{log.name}: scored over {end - begin:.1f} s of {whole:.1f} s: the reference is there from {begin:.1f} s to {end:.1f} s",
    )


def with_pauses(log: Log, skipped: Sequence[tuple[float, float]], tick_gap: float) -> tuple[str, ...]:
    """Gaps (begin, end) [s] between measurements inside of which there are no estimates."""
    if not skipped:
        return ()
    begin, end = max(skipped, key=lambda gap: gap[1] - gap[0])
    count = "a gap" if len(skipped) == 1 else f"{len(skipped)} gaps"
    return (
        f"{log.name}: {count} above {tick_gap:g} s without any measurement, the longest {end - begin:.0f} s at {begin:.1f} s: "
        "there are no estimates inside",
    )


def check_free_map(log: Log, sensors: Sequence[str], name: str, settings: FileModel) -> None:
    """InputError where landmarks are to be estimated (by the setting ``landmarks`` of the estimator ``name``) and no sighting tells
    where one is, nor is of one that the map keeps: all would be ignored."""
    use = getattr(settings, "landmarks", "known")
    stream = log.streams.get("bearing_range")
    if (
        use == "known"
        or "bearing_range" not in sensors
        or not isinstance(stream, BearingRangeStream)
        or not len(stream.t)
    ):
        return
    if np.any(np.isfinite(stream.range) & np.isfinite(stream.bearing)):
        return
    if use == "extended" and any(landmark in log.world.landmarks for landmark in stream.landmark):
        return
    lacks = "bearing" if np.any(np.isfinite(stream.range)) else "range"
    raise InputError(
        f"{log.name}: {name}.landmarks is {use}, but no sighting has a {lacks}, so no landmark can be placed; give a map of them "
        f"(--world) with {name}.landmarks=known, or leave out bearing_range (--sensors)"
    )


def without_tags(log: Log, estimator: str, diagnostics: Diagnostics) -> tuple[str, ...]:
    """Scans of tags went to an estimator that takes none."""
    rounds = diagnostics.ignored.get("rfid", 0)
    if not rounds or estimator == "dead_reckoning":  # which says so by its name
        return ()
    return (f"{log.name}: {estimator} takes no tags: all {rounds} inventory rounds are ignored",)


def dead_tags(log: Log, diagnostics: Diagnostics) -> tuple[str, ...]:
    """Tags of the map that are believed dead at the end, the surest first; or that no tag is read."""
    stream = log.streams.get("rfid")
    if isinstance(stream, RfidStream) and log.world.tags and not any(epc in log.world.tags for epc in stream.epc):
        return (f"{log.name}: none of the {len(log.world.tags)} tags of the map is read",)
    found = sorted(diagnostics.dead_tags.items(), key=lambda row: -row[1])
    if not found:
        return ()
    names = ", ".join(f"{name} ({_percent(dead)})" for name, dead in found[:SHOWN])
    more = len(found) - SHOWN
    return (
        f"{log.name}: {len(found)} of {len(log.world.tags)} tags of the map are believed dead, as they were not read from where "
        f"they should have been: {names}" + (f" and {more} more" if more > 0 else ""),
    )


def _percent(probability: float) -> str:
    return "> 99 %" if probability > 0.99 else f"{100.0 * probability:.0f} %"


def without_points(
    log: Log, sensors: Sequence[str], name: str, estimator: Estimator, settings: FileModel
) -> tuple[str, ...]:
    """A camera that is used, a map without points that it could find, and an estimator (by its ``name``) that needs them."""
    used = [sensor for sensor in OF_CAMERA if sensor in sensors]
    points = log.world.points
    if not used or CAMERA not in getattr(estimator, "modalities", ()):
        return ()
    if points is not None and len(points.owners if used == [CAMERA] else points):
        return ()
    if getattr(settings, "visual_odometry", False):
        return ()
    others = ""
    if getattr(estimator, "estimates_points", False):
        if getattr(settings, "landmarks", "known") != "known":
            return ()
        others = f", or {name}.landmarks=unknown"
    return (f"{log.name}: the map has no points that a camera could find: give --world{others}",)


def findable(log: Log, sensors: Sequence[str]) -> list[tuple[str, str]]:
    """What ``sensors`` could find in the map, each with the words for that nothing of it was."""
    world = log.world
    kinds = []
    if world.landmarks and "bearing_range" in sensors:
        kinds.append(("landmarks", "no landmark of the map was seen"))
    if world.tags and "rfid" in sensors:
        kinds.append(("tags", "no tag of the map was read"))
    if world.points is not None and any(sensor in sensors for sensor in OF_CAMERA):
        kinds.append(("points", "no point of the map was found in an image"))
    return kinds


def never_localized(
    log: Log, sensors: Sequence[str], estimates: Sequence[PoseEstimate], final: Trajectory
) -> tuple[str, ...]:
    """An unknown start that nothing told, in terms of what ``sensors`` find in the map."""
    found = {e.status for e in estimates}
    if "localized" in found or (
        len(final) and estimates[-1].status == "unlocalized"
    ):  # or it says nothing before the end
        return ()
    kinds = findable(log, sensors)
    names = " and ".join(name for name, _ in kinds)
    if not kinds:
        why = "the map has nothing that its sensors could find"
    elif "ambiguous" in found:
        why = f"its {names} leave several places possible"
    elif len(kinds) > 1:  # an estimator need not take all of them
        why = f"its {names} did not tell the place"
    else:
        why = kinds[0][1]
    return (f"{log.name}: never localized: {why}",)
