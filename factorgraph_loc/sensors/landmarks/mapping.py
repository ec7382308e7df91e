"""Checks whether landmarks can be mapped from a log."""

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings


def check(log: Log) -> None:
    """InputError if the log's sightings cannot locate any landmark."""
    stream = log.streams.get("bearing_range")
    if not isinstance(stream, BearingRangeStream) or not len(stream.t):
        raise InputError(f"{log.name}: has no sightings of landmarks (bearing_range), so there is nothing to map")
    if log.rig.find(BearingRangeSettings) is None:
        raise InputError(f"{log.name}: its rig has no [bearing_range], expected the sensor's noise and mounting")
    if not np.any(np.isfinite(stream.range) & np.isfinite(stream.bearing)):
        lacking, what = ("bearing", "range") if np.isfinite(stream.range).any() else ("range", "bearing")
        raise InputError(
            f"{log.name}: no sighting has a {lacking}; from a {what} alone a landmark cannot be located, so it cannot be mapped"
        )
