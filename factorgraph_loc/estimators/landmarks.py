"""Identified landmarks of the known map, as all estimators take them in."""

from __future__ import annotations

import numpy as np

from factorgraph_loc.estimators.base import Diagnostics
from factorgraph_loc.estimators.registry import Setup
from factorgraph_loc.measurements import BearingRange
from factors.bearing_range import BearingRangeFactor
from factors.odometry import Increment
from factors.se2 import Array


class KnownLandmarks:
    """Turns measurements into factors on a pose; what the map or the rig lacks is counted as ignored."""

    def __init__(self, setup: Setup, diagnostics: Diagnostics) -> None:
        settings = setup.rig.bearing_range if "bearing_range" in setup.sensors else None
        self._model = None if settings is None else settings.model()
        self._positions = {name: np.array((m.x, m.y)) for name, m in setup.world.landmarks.items()}
        self._diagnostics = diagnostics

    def factor(self, m: BearingRange, offset: Increment | None = None) -> BearingRangeFactor | None:
        """The factor of a measurement, on the pose at its time, or on the one that lies ``offset`` before it."""
        if self._model is None:
            self._diagnostics.ignore("bearing_range", len(m.landmarks))
            return None
        rows = [i for i, name in enumerate(m.landmarks) if name in self._positions and _has_value(m, i)]
        if len(rows) < len(m.landmarks):
            self._diagnostics.ignore("landmark not in the map", len(m.landmarks) - len(rows))
        if not rows:
            return None
        points = np.array([self._positions[m.landmarks[i]] for i in rows])
        ranges, bearings = m.range[rows], m.bearing[rows]
        if offset is None:
            return BearingRangeFactor(self._model, points, ranges, bearings)
        return BearingRangeFactor(self._model, points, ranges, bearings, offset.delta, offset.covariance)

    def report(self, t: float, factor: BearingRangeFactor, innovation: Array, h: Array, covariance: Array) -> None:
        """Record the normalised innovation squared of whitened innovations (2K,) with Jacobian ``h`` (2K, 3)."""
        used = np.stack((~np.isnan(factor.ranges), ~np.isnan(factor.bearings)), axis=-1).ravel()
        e, j = innovation[used], h[used]
        s = j @ covariance @ j.T + np.eye(len(e))
        self._diagnostics.innovation("bearing_range", t, float(e @ np.linalg.solve(s, e)), len(e))


def _has_value(m: BearingRange, i: int) -> bool:
    return not (np.isnan(m.range[i]) and np.isnan(m.bearing[i]))
