"""Plots of RFID tags."""

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.interfaces import Marks
from factorgraph_loc.sensors.rfid.settings import SurveySettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.rfid.tag_map import tag_map


def draw(log: Log) -> Marks:
    """The tags of the map, corrected by the rig's survey transform, and the times of their reads."""
    known = tag_map(log.world, log.rig.of(SurveySettings))
    stream = log.streams.get("rfid")
    t, seen = np.empty(0), tuple[str, ...]()
    if isinstance(stream, RfidStream):
        rows = [i for i, epc in enumerate(stream.epc) if epc]
        t = (stream.t - stream.age + log.rig.time_offset("rfid"))[rows]
        seen = tuple(stream.epc[i] for i in rows)
    return Marks("tags", known.names, known.tags.points, t, seen, marker="s", size=5.0, order=2.0)
