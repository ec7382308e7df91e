"""The rows of a sensor of identified landmarks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factors.se2 import Array


@dataclass(frozen=True)
class BearingRangeStream:
    """One row a landmark: its name, range [m] and bearing [rad] (NaN where not measured). Rows of one stamp belong together."""

    t: Array
    landmark: Sequence[str]
    range: Array
    bearing: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        bounds = [*np.flatnonzero(np.diff(self.t, prepend=np.nan) != 0.0).tolist(), len(self.t)]
        for i, j in pairwise(bounds):
            yield BearingRange(float(self.t[i]) + offset, tuple(self.landmark[i:j]), self.range[i:j], self.bearing[i:j])
