"""The map, as in a file ``NAME.world.toml``: layers of named elements, which sensors register, points, and walls.

A layer may be stored in a table next to the file, such as ``NAME.tags.csv``. Points are always stored in
``NAME.points.parquet``.
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
    """A map. ``points``: points that cameras observe. ``walls``: segments (x1, y1, x2, y2) [m]. Further attributes
    (layers) are dictionaries of surveyed objects: ``landmarks`` by name, and RFID ``tags`` by EPC."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    name: str = "world"
    points: PointMap | None = None
    walls: tuple[tuple[Coordinate, Coordinate, Coordinate, Coordinate], ...] = ()

    if TYPE_CHECKING:

        def __init__(self, **values: Any) -> None: ...
        def __getattr__(self, layer: str) -> Any: ...

    def of(self, kind: type[L]) -> dict[str, L]:
        """Return the layer of the map with elements of the class ``kind``, as {name: element}."""
        layer: dict[str, L] = getattr(self, next(name for name, of_layer in _KINDS.items() if of_layer is kind))
        return layer

    def position(self, name: str) -> Array | None:
        """Return the position (2,) [m] of a landmark. Returns None if it is not in the map."""
        landmark = self.landmarks.get(name)
        return None if landmark is None else np.array((landmark.x, landmark.y))

    def positions(self) -> Array:
        """Return the positions (K, 2) [m] of all K landmarks, in the order of the map's attribute ``landmarks``."""
        return np.array([(landmark.x, landmark.y) for landmark in self.landmarks.values()]).reshape(-1, 2)


_KINDS: dict[str, type[FileModel]] = {name: load(layer.kind) for name, layer in layers().items()}
add_fields(
    World,
    {n: (dict.__class_getitem__((str, kind)), Field(default_factory=dict)) for n, kind in _KINDS.items()},
    after="name",
)
