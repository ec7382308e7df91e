"""What sensors see of a particle filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from factorgraph_loc.fusion.cloud import vector_moments
from factorgraph_loc.fusion.filter import Filter
from factorgraph_loc.fusion.layout import MOTION
from factorgraph_loc.sensors.base import EarlierPose
from factors import se2
from factors.se2 import Array


class CloudView:
    """What sensors see of the filter, at its time."""

    offset = None
    newest = True

    def __init__(self, owner: Filter) -> None:
        self._filter: Any = owner
        self.t = owner._t

    @property
    def localized(self) -> bool:
        return bool(self._filter._state.localized)

    @property
    def pose(self) -> Array:
        return np.asarray(self._filter._moments()[0], dtype=float)

    @property
    def covariance(self) -> Array:
        return se2.world_to_body(*self._filter._moments())

    def value(self, name: str) -> Array | None:
        cloud, part = self._filter._state, self._filter._state.parts.get(name)
        return None if part is None else np.asarray(cloud.weights @ cloud.constants[:, part])

    def spread(self, name: str) -> Array:
        cloud, part = self._filter._state, self._filter._state.parts[name]
        return vector_moments(cloud.constants[:, part], cloud.weights)[1]

    def joint(self) -> tuple[Array, Mapping[str, slice]]:
        return self.covariance, {}

    def poses_at(self, times: Array) -> Array:
        constants = self.value(MOTION)
        owner = self._filter
        values = np.zeros(0) if constants is None else constants
        return np.asarray(owner._motion.poses_at(owner._odometry, times, values))

    def earlier(self, t: float) -> EarlierPose | None:
        return None

    def values(self, names: Sequence[str]) -> dict[str, Array]:
        """The means of blocks that travel with the particles."""
        return {name: value for name in names if (value := self.value(name)) is not None}
