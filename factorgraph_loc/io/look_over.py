"""Warnings about a whole log."""

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.checks import ROUNDING
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.landmarks.stream import BearingRangeStream

MAX_ODOMETRY_GAP = 5.0  # s


def look_over(log: Log) -> list[str]:
    """Warnings about a whole log; InputError if it has no odometry, which only a hand-held camera and a bare trajectory lack."""
    odometry = log.streams.get("odometry")
    if odometry is None and (log.reference3 is not None or (log.reference is not None and not log.streams)):
        return []
    if odometry is None or len(odometry.t) == 0:
        raise InputError(f"{log.name}: has no odometry, which every estimator needs")
    warnings = []
    gaps = np.diff(odometry.t)
    wide = np.flatnonzero(gaps > MAX_ODOMETRY_GAP + ROUNDING)
    if len(wide):
        i = int(np.argmax(gaps))
        count = "a gap" if len(wide) == 1 else f"{len(wide)} gaps"
        warnings.append(
            f"odometry: {count} above {MAX_ODOMETRY_GAP:g} s, the longest {gaps[i]:.1f} s at t = {odometry.t[i]:.3f} s"
        )
    for name, stream in log.streams.items():
        if name != "odometry" and (early := int(np.count_nonzero(stream.t < odometry.t[0]))):
            warnings.append(f"{name}: {early} rows come before the first odometry")
    sightings = log.streams.get("bearing_range")
    if isinstance(sightings, BearingRangeStream):
        unknown = [name for name in sightings.landmark if name not in log.world.landmarks]
        if unknown:
            names = sorted(set(unknown))
            shown = ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")
            warnings.append(f"bearing_range: {len(unknown)} rows name landmarks that the map lacks: {shown}")
    return warnings
