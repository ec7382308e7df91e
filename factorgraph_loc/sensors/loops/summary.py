"""Summary of the loops in a log: how many there are, and with a reference how many of them can be right."""

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.interfaces import Paragraph, Summary
from factorgraph_loc.sensors.loops.measurement import LoopStream

NEAR = 1.0  # m: farther from each other two poses are not at one place
GAP = 5.0  # s between poses of the reference


def summarize(log: Log) -> Summary:
    """The number of loops, of those with a relative pose, and of those that join places near to each other in the reference."""
    stream = log.streams.get("loops")
    if not isinstance(stream, LoopStream) or not len(stream.t):
        return Summary()
    placed = int(np.count_nonzero(np.isfinite(stream.x)))
    found: dict[str, float] = {"count": len(stream.t), "with_pose": placed}
    line = f"{len(stream.t)} loops, {placed} of them with a relative pose"
    if log.reference is not None:
        t = stream.t + log.rig.time_offset("loops")
        here, there = (log.reference.at(at, max_gap=GAP)[:, :2] for at in (t, t - stream.age))
        apart = np.linalg.norm(here - there, axis=1)
        told = np.hypot(np.nan_to_num(stream.x), np.nan_to_num(stream.y))
        known = np.isfinite(apart)
        near = np.abs(apart[known] - told[known]) < NEAR
        found |= {"compared": int(np.count_nonzero(known)), "near": int(np.count_nonzero(near))}
        if known.any():
            line += f"; of {len(near)} within the reference {np.mean(near):.0%} are right to {NEAR:g} m"
    return Summary({"loops": found}, text=[Paragraph(line)])
