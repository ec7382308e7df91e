"""What is around the robot: landmarks with their positions, read from and written to ``NAME.world.toml``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.files import FileModel, parse_model, read_toml, write_toml
from factors.se2 import Array


class Landmark(FileModel):
    """A point landmark: position [m] in the world's frame and the standard deviation of its survey in x and y [m]."""

    x: float
    y: float
    sigma: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0


class World(FileModel):
    """A map. ``landmarks``: by name, as measurements name them."""

    name: str = "world"
    landmarks: dict[str, Landmark] = Field(default_factory=dict)

    def position(self, landmark: str) -> Array | None:
        """Position (2,) of a landmark, or None if the map lacks it."""
        found = self.landmarks.get(landmark)
        return None if found is None else np.array((found.x, found.y))

    def positions(self) -> Array:
        """Positions (K, 2) of all landmarks, in the order of the map."""
        return np.array([(m.x, m.y) for m in self.landmarks.values()]).reshape(-1, 2)


def read_world(path: Path) -> World:
    """Read ``NAME.world.toml``; InputError names file, key and what is expected."""
    return parse_model(World, read_toml(path), path)


def write_world(world: World, path: Path) -> None:
    """Write ``NAME.world.toml``."""
    write_toml(path, world.model_dump(mode="json"))
