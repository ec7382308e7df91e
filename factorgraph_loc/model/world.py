"""The map, read from and written to ``NAME.world.toml``: layers of named elements registered by sensors, points, and walls.

A layer may be kept in a table next to the file, such as ``NAME.tags.csv``; points always are, in ``NAME.points.parquet``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from pydantic import ConfigDict, Field

from factorgraph_loc.files.models import Coordinate, FileModel, add_fields
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.sections import layers
from factorgraph_loc.plugins import load
from factors.se2 import Array

L = TypeVar("L", bound=FileModel)


class World(FileModel):
    """A map. ``points``: points that cameras see. ``walls``: segments (x1, y1, x2, y2) [m]. Layers hold surveyed
    elements by name, for example ``landmarks``, and RFID ``tags`` by EPC."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    name: str = "world"
    points: PointMap | None = None
    walls: tuple[tuple[Coordinate, Coordinate, Coordinate, Coordinate], ...] = ()

    if TYPE_CHECKING:

        def __init__(self, **values: Any) -> None: ...
        def __getattr__(self, layer: str) -> Any: ...

    def of(self, kind: type[L]) -> dict[str, L]:
        """The layer whose elements have class ``kind``."""
        layer: dict[str, L] = getattr(self, next(name for name, of_layer in _KINDS.items() if of_layer is kind))
        return layer

    def position(self, name: str) -> Array | None:
        """Position (2,) of a landmark; None if it is not in the map."""
        landmark = self.landmarks.get(name)
        return None if landmark is None else np.array((landmark.x, landmark.y))

    def positions(self) -> Array:
        """Positions (K, 2) of all landmarks, in the order of the map."""
        return np.array([(landmark.x, landmark.y) for landmark in self.landmarks.values()]).reshape(-1, 2)


_KINDS: dict[str, type[FileModel]] = {name: load(layer.kind) for name, layer in layers().items()}
add_fields(
    World,
    {n: (dict.__class_getitem__((str, kind)), Field(default_factory=dict)) for n, kind in _KINDS.items()},
    after="name",
)
