"""Landmarks that the map lacks: when one is taken in, and where it is."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from factorgraph_loc.estimators.landmarks import GATE
from factors.se2 import Array

MAX_PENDING = 5  # sightings that wait for another to agree

Sighting = TypeVar("Sighting")


@dataclass
class NewLandmarks(Generic[Sighting]):
    """Sightings of landmarks that are not taken in yet: that needs two that agree where it is, as one may be an outlier."""

    _pending: dict[str, list[tuple[Array, Array, Sighting]]] = field(default_factory=dict)

    def propose(self, name: str, point: Array, covariance: Array, sighting: Sighting) -> Sighting | None:
        """A sighting that puts the landmark at ``point`` (2,) with ``covariance`` (2, 2): an earlier one that agrees, or None."""
        pending = self._pending.setdefault(name, [])
        for earlier, spread, candidate in reversed(pending):
            apart = point - earlier
            if apart @ np.linalg.solve(spread + covariance, apart) < GATE:
                del self._pending[name]
                return candidate
        pending.append((point, covariance, sighting))
        del pending[:-MAX_PENDING]
        return None
