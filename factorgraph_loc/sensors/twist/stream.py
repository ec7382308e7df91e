"""The stream of measured motion in space."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from factorgraph_loc.model.measurement import Measurement, Stream
from factorgraph_loc.sensors.twist.measurement import Twist
from factors.se2 import Array


@dataclass(frozen=True)
class TwistStream(Stream):
    """``v`` (N, 3) [m/s] and ``w`` (N, 3) [rad/s] in the robot frame, each held until the next row."""

    rank: ClassVar[int] = 1
    v: Array
    w: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        return map(Twist, (self.t + offset).tolist(), self.v, self.w)
