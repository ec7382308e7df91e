"""What is around the robot: landmarks with their positions, read from and written to ``NAME.world.toml``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator

from factorgraph_loc.files import FileModel, parse_model, read_toml, write_toml
from factors.se2 import Array


class Landmark(FileModel):
    """A point landmark: position [m] in the world's frame, and how well it is known.

    ``sigma``: standard deviation of its survey in x and y [m]. ``covariance``: (xx, xy, yy) [m^2], in place of ``sigma``, where
    the map was made from a log and the errors in x and y differ or go together.
    """

    x: float
    y: float
    sigma: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    covariance: tuple[float, float, float] | None = None

    @field_validator("covariance")
    @classmethod
    def _is_positive_semidefinite(cls, value: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if value is not None:
            xx, xy, yy = value
            # of a singular matrix the determinant may round to a little below zero
            if xx < 0.0 or yy < 0.0 or xy * xy > xx * yy * (1.0 + 1e-9):
                raise ValueError("expected (xx, xy, yy) [m^2] of a positive semi-definite matrix")
        return value

    def spread(self) -> Array:
        """The covariance (2, 2) of the position [m^2]."""
        if self.covariance is None:
            return self.sigma**2 * np.eye(2)
        xx, xy, yy = self.covariance
        return np.array(((xx, xy), (xy, yy)))


class Tag(FileModel):
    """An RFID tag: position [m] as it was surveyed, and the direction that it faces [rad], None where that is not known.

    ``sigma``: standard deviation of its survey in x and y [m]; ``covariance``: (xx, xy, yy) [m^2] in place of it, as of a
    :class:`Landmark`.
    """

    x: float
    y: float
    z: float = 0.0
    facing: Annotated[float, Field(ge=-2.0 * math.pi, le=2.0 * math.pi, description="rad, not degrees")] | None = None
    sigma: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    covariance: tuple[float, float, float] | None = None


class World(FileModel):
    """A map. ``landmarks``: by name, as measurements name them. ``tags``: RFID tags by EPC, as they were surveyed: what a rig
    knows of the survey's errors is applied where they are used. ``walls``: segments (x1, y1, x2, y2) [m]."""

    name: str = "world"
    landmarks: dict[str, Landmark] = Field(default_factory=dict)
    tags: dict[str, Tag] = Field(default_factory=dict)
    walls: tuple[tuple[float, float, float, float], ...] = ()

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
    write_toml(path, world.model_dump(mode="json", exclude_none=True))
