"""Measurements of identified landmarks, their stream, and its table."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from factorgraph_loc.files.columns import ANGLE, FULL_TURN, LENGTH, LONGEST_RANGE, NEAREST, STAMP, Table, named, number
from factorgraph_loc.model.measurement import ScanStream
from factors.se2 import Array

BEARING_RANGE = Table(
    "bearing_range",
    (
        STAMP,
        named("landmark", "the name of a landmark"),
        # radios report 0 without an answer, and gross errors may be negative: these are missing values
        number(
            "range",
            LENGTH,
            -LONGEST_RANGE,
            LONGEST_RANGE,
            "distance; a value below 0.001 is skipped",
            may_lack=True,
            left_out_below=NEAREST,
        ),
        number("bearing", ANGLE, -FULL_TURN, FULL_TURN, "direction in the sensor frame", may_lack=True),
    ),
    "one measurement",
    stream="factorgraph_loc.sensors.landmarks.measurement:BearingRangeStream",
)


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
    source: str = modality

    @property
    def count(self) -> int:
        """Number of landmarks seen."""
        return len(self.landmarks)


@dataclass(frozen=True)
class BearingRangeStream(ScanStream):
    """Rows of landmarks: name, range [m] and bearing [rad], NaN if not measured. Rows of one timestamp form one measurement."""

    kind: ClassVar[type[Any]] = BearingRange
    landmark: Sequence[str]
    range: Array
    bearing: Array
