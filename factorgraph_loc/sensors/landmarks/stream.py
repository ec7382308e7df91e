"""The stream of a landmark sensor."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from factorgraph_loc.model.measurement import ScanStream
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factors.se2 import Array


@dataclass(frozen=True)
class BearingRangeStream(ScanStream):
    """Rows of landmarks: name, range [m] and bearing [rad], NaN if not measured. Rows of one timestamp form one measurement."""

    kind: ClassVar[type[Any]] = BearingRange
    landmark: Sequence[str]
    range: Array
    bearing: Array
