"""Positions of landmarks from single sightings, in the robot frame; initialization of landmarks that are not in the map."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings
from factors import positive
from factors.landmarks.model import located, sigmas
from factors.se2 import Array
from factors.update import GATE

STEP = 1e-6  # m or rad; of numerical derivatives
MAX_PENDING = 5  # sightings per landmark that wait for another to agree

Pending = TypeVar("Pending")


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


@dataclass(frozen=True)
class NewLandmarks(Generic[Pending]):
    """Sightings of landmarks that are not initialized yet: two must agree on the position, because one may be an outlier.

    Immutable, because filters go back to an earlier state when a measurement is late.
    """

    pending: Mapping[str, tuple[tuple[Array, Array, Pending], ...]] = field(default_factory=dict)

    def propose(
        self, name: str, point: Array, covariance: Array, sighting: Pending
    ) -> tuple[NewLandmarks[Pending], Pending | None]:
        """Add a sighting that puts the landmark at ``point`` (2,) with ``covariance`` (2, 2). Returns the new pending sightings,
        and an earlier sighting that agrees, or None."""
        waiting = self.pending.get(name, ())
        for earlier, spread, candidate in reversed(waiting):
            apart = point - earlier
            if positive.squared(apart, spread + covariance) < GATE:
                return NewLandmarks({other: rows for other, rows in self.pending.items() if other != name}), candidate
        return NewLandmarks({**self.pending, name: (*waiting, (point, covariance, sighting))[-MAX_PENDING:]}), None
