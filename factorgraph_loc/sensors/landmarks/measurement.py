"""Measurements of identified landmarks."""

from dataclasses import dataclass
from typing import ClassVar

from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class BearingRange:
    """Identified landmarks seen at one time.

    ``landmarks``: K names. ``range`` (K,) [m] and ``bearing`` (K,) [rad, in the sensor frame]: NaN if not measured.
    """

    sensor: ClassVar[str] = "bearing_range"
    modality: ClassVar[str] = "bearing_range"
    is_motion: ClassVar[bool] = False
    t: float
    landmarks: tuple[str, ...]
    range: Array
    bearing: Array

    @property
    def count(self) -> int:
        """Number of landmarks seen."""
        return len(self.landmarks)
