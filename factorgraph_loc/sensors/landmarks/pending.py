"""Landmarks that the map lacks: when one is taken in, and where it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from factors import positive
from factors.se2 import Array
from factors.update import GATE

MAX_PENDING = 5  # sightings that wait for another to agree

Sighting = TypeVar("Sighting")


@dataclass(frozen=True)
class NewLandmarks(Generic[Sighting]):
    """Sightings of landmarks that are not taken in yet: that needs two that agree where it is, as one may be an outlier.

    A value: filters go back to an earlier one when a measurement is late.
    """

    pending: Mapping[str, tuple[tuple[Array, Array, Sighting], ...]] = field(default_factory=dict)

    def propose(
        self, name: str, point: Array, covariance: Array, sighting: Sighting
    ) -> tuple[NewLandmarks[Sighting], Sighting | None]:
        """With a sighting that puts the landmark at ``point`` (2,) with ``covariance`` (2, 2): what waits from now on, and an
        earlier sighting that agrees, or None."""
        waiting = self.pending.get(name, ())
        for earlier, spread, candidate in reversed(waiting):
            apart = point - earlier
            if positive.squared(apart, spread + covariance) < GATE:
                return NewLandmarks({other: rows for other, rows in self.pending.items() if other != name}), candidate
        return NewLandmarks({**self.pending, name: (*waiting, (point, covariance, sighting))[-MAX_PENDING:]}), None
