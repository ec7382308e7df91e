"""The rows of a sensor of identified landmarks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from factorgraph_loc.model.stream import ScanStream
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factors.se2 import Array


@dataclass(frozen=True)
class BearingRangeStream(ScanStream):
    """One row a landmark: its name, range [m] and bearing [rad] (NaN where not measured). Rows of one stamp belong together."""

    kind: ClassVar[type[Any]] = BearingRange
    landmark: Sequence[str]
    range: Array
    bearing: Array
