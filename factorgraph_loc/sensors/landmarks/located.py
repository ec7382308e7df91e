"""Positions of landmarks from single sightings, in the robot frame."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings
from factorgraph_loc.sensors.landmarks.stream import BearingRangeStream
from factors.landmarks.model import located, sigmas
from factors.se2 import Array

STEP = 1e-6  # m or rad; of numerical derivatives


class LocatedLandmark(NamedTuple):
    """A ``landmark`` seen at ``t`` [s of the log] at ``point`` (2,) [m] with ``covariance`` (2, 2) [m^2], in the robot frame."""

    t: float
    landmark: str
    point: Array
    covariance: Array


def located_landmarks(log: Log, sensors: Collection[str], names: Collection[str]) -> list[LocatedLandmark]:
    """The landmarks in ``names`` for which range and bearing were measured at once; empty if the log's sightings are not among
    ``sensors``, or its rig lacks the sensor."""
    stream, settings = log.streams.get("bearing_range"), log.rig.find(BearingRangeSettings)
    if "bearing_range" not in sensors or not isinstance(stream, BearingRangeStream) or settings is None:
        return []
    model = settings.model()
    whole = np.flatnonzero(np.isfinite(stream.range) & np.isfinite(stream.bearing))
    rows = [i for i in whole.tolist() if stream.landmark[i] in names]
    ranges, bearings = stream.range[rows], stream.bearing[rows]
    points = located(model, ranges, bearings)
    spreads = sigmas(model, ranges)
    t = (stream.t[rows] + log.rig.time_offset("bearing_range")).tolist()
    by_range = (located(model, ranges + STEP, bearings) - points) / STEP
    by_bearing = (located(model, ranges, bearings + STEP) - points) / STEP
    jacobians = np.stack((by_range, by_bearing), axis=-1) * spreads[:, None, :]
    covariances = jacobians @ np.swapaxes(jacobians, 1, 2)
    return [LocatedLandmark(t[k], stream.landmark[i], points[k], covariances[k]) for k, i in enumerate(rows)]
