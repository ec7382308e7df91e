"""What a run can do with landmarks, and plots of them."""

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.interfaces import Marks, Use
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream


def check(use: Use) -> Use:
    """InputError if landmarks are to be estimated (setting ``landmarks`` of the estimator) but no sighting determines the
    position of one or shows a landmark of the map."""
    log, wanted = use.log, getattr(use.settings, "landmarks", "known")
    stream = log.streams.get("bearing_range")
    if wanted == "known" or "bearing_range" not in use.sensors:
        return use
    if not isinstance(stream, BearingRangeStream) or not len(stream.t):
        return use
    if np.any(np.isfinite(stream.range) & np.isfinite(stream.bearing)):
        return use
    if wanted == "extended" and any(landmark in log.world.landmarks for landmark in stream.landmark):
        return use
    lacks = "bearing" if np.any(np.isfinite(stream.range)) else "range"
    name = use.estimator
    raise InputError(
        f"{log.name}: {name}.landmarks is {wanted}, but no sighting has a {lacks}, so no landmark can be located; give a map of "
        f"them (--world) with {name}.landmarks=known, or leave out bearing_range (--sensors)"
    )


def draw(log: Log) -> Marks:
    """The landmarks of the map, on the floor, and the times of their sightings."""
    places = log.world.positions()
    positions = np.column_stack((places, np.zeros(len(places))))
    stream = log.streams.get("bearing_range")
    t, seen = np.empty(0), tuple[str, ...]()
    if isinstance(stream, BearingRangeStream):
        t, seen = stream.t + log.rig.time_offset("bearing_range"), tuple(stream.landmark)
    return Marks("landmarks", tuple(log.world.landmarks), positions, t, seen, marker="^", size=7.0, order=4.0)
