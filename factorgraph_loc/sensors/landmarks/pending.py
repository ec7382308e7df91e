"""Initialization of landmarks that are not in the map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from factors import positive
from factors.se2 import Array
from factors.update import GATE

MAX_PENDING = 5  # sightings per landmark that wait for another to agree

Sighting = TypeVar("Sighting")


@dataclass(frozen=True)
class NewLandmarks(Generic[Sighting]):
    """Sightings of landmarks that are not initialized yet: two must agree on the position, because one may be an outlier.

    Immutable, because filters go back to an earlier state when a measurement is late.
    """

    pending: Mapping[str, tuple[tuple[Array, Array, Sighting], ...]] = field(default_factory=dict)

    def propose(
        self, name: str, point: Array, covariance: Array, sighting: Sighting
    ) -> tuple[NewLandmarks[Sighting], Sighting | None]:
        """Add a sighting that puts the landmark at ``point`` (2,) with ``covariance`` (2, 2). Returns the new pending sightings,
        and an earlier sighting that agrees, or None."""
        waiting = self.pending.get(name, ())
        for earlier, spread, candidate in reversed(waiting):
            apart = point - earlier
            if positive.squared(apart, spread + covariance) < GATE:
                return NewLandmarks({other: rows for other, rows in self.pending.items() if other != name}), candidate
        return NewLandmarks({**self.pending, name: (*waiting, (point, covariance, sighting))[-MAX_PENDING:]}), None
