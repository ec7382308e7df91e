"""Plots of landmarks."""

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.landmarks.stream import BearingRangeStream
from factorgraph_loc.sensors.marks import Marks


def draw(log: Log) -> Marks:
    """The landmarks of the map, on the floor, and the times of their sightings."""
    places = log.world.positions()
    positions = np.column_stack((places, np.zeros(len(places))))
    stream = log.streams.get("bearing_range")
    t, seen = np.empty(0), tuple[str, ...]()
    if isinstance(stream, BearingRangeStream):
        t, seen = stream.t + log.rig.time_offset("bearing_range"), tuple(stream.landmark)
    return Marks("landmarks", tuple(log.world.landmarks), positions, t, seen, marker="^", size=7.0, order=4.0)
