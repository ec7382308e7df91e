"""Summary of a compass in a log."""

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.interfaces import Paragraph, Summary
from factors import se2


def summarize(log: Log) -> Summary:
    """The median difference of its headings to the reference."""
    stream = log.streams.get("compass")
    if stream is None or log.reference is None or not log.reference.has_heading:
        return Summary()
    there = log.reference.at(stream.t + log.rig.time_offset("compass"), max_gap=0.5)[:, 2]
    bias = float(np.nanmedian(se2.wrap(stream.heading - there)))
    return Summary({"compass": {"bias": bias}}, text=[Paragraph(f"the compass reports {bias:.3f} rad too much")])
