"""What is around the robot: landmarks and tags with their positions, read from and written to ``NAME.world.toml``.

Many tags are better kept in a table beside it, ``NAME.tags.csv``; points that a camera sees always are, as ``NAME.points.parquet``.
"""

from __future__ import annotations

import numpy as np
from pydantic import ConfigDict, Field

from factorgraph_loc.files.models import Coordinate, FileModel
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.sensors.landmarks.map import Landmark
from factorgraph_loc.sensors.rfid.map import Tag
from factors.se2 import Array


class World(FileModel):
    """A map. ``landmarks``: by name, as measurements name them. ``tags``: RFID tags by EPC, as they were surveyed: what a rig
    knows of the survey's errors is applied where they are used. ``points``: what a camera sees. ``walls``: segments (x1, y1, x2,
    y2) [m]."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    name: str = "world"
    landmarks: dict[str, Landmark] = Field(default_factory=dict)
    tags: dict[str, Tag] = Field(default_factory=dict)
    points: PointMap | None = None
    walls: tuple[tuple[Coordinate, Coordinate, Coordinate, Coordinate], ...] = ()

    def position(self, landmark: str) -> Array | None:
        """Position (2,) of a landmark, or None if the map lacks it."""
        found = self.landmarks.get(landmark)
        return None if found is None else np.array((found.x, found.y))

    def positions(self) -> Array:
        """Positions (K, 2) of all landmarks, in the order of the map."""
        return np.array([(m.x, m.y) for m in self.landmarks.values()]).reshape(-1, 2)
