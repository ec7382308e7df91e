"""The rows of a sensor of identified landmarks."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.stream import Stream
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factors.se2 import Array


@dataclass(frozen=True)
class BearingRangeStream(Stream):
    """One row a landmark: its name, range [m] and bearing [rad] (NaN where not measured). Rows of one stamp belong together."""

    landmark: Sequence[str]
    range: Array
    bearing: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        for i, j in self.scans():
            yield BearingRange(float(self.t[i]) + offset, tuple(self.landmark[i:j]), self.range[i:j], self.bearing[i:j])
