"""Identified points in an image."""

from dataclasses import dataclass
from typing import ClassVar

from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class PixelSightings:
    """Identified points seen in one image: ``points``: K names; ``pixels`` (K, 2) [px], x right, y down; ``right``: by the second
    camera of a stereo pair."""

    modality: ClassVar[str] = "camera"
    is_motion: ClassVar[bool] = False
    frame: ClassVar[None] = None  # no features were looked for
    t: float
    points: tuple[str, ...]
    pixels: Array
    right: bool = False

    @property
    def sensor(self) -> str:
        """The sensor that saw them."""
        return "sightings_right" if self.right else "sightings"

    @property
    def names(self) -> tuple[str, ...]:
        """Those of the points."""
        return self.points

    @property
    def count(self) -> int:
        """How many points were seen."""
        return len(self.pixels)
