"""Named points in an image."""

from dataclasses import dataclass
from typing import ClassVar

from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class PixelSightings:
    """Named points seen in one image: ``points``: K names; ``pixels`` (K, 2) [px], x right, y down."""

    sensor: ClassVar[str] = "sightings"
    modality: ClassVar[str] = "camera"
    is_motion: ClassVar[bool] = False
    frame: ClassVar[None] = None  # there are no features
    t: float
    points: tuple[str, ...]
    pixels: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the points."""
        return self.points

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.pixels)
