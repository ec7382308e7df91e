"""What a compass reports, and its rows in a log."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.stream import Stream
from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class Heading:
    """The direction of the robot's x axis in the world, ``heading`` [rad], with the compass's bias."""

    sensor: ClassVar[str] = "compass"
    modality: ClassVar[str] = "compass"
    is_motion: ClassVar[bool] = False
    count: ClassVar[int] = 1
    t: float
    heading: float


@dataclass(frozen=True)
class HeadingStream(Stream):
    """``heading`` (N,) [rad]."""

    heading: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        return map(Heading, (self.t + offset).tolist(), self.heading.tolist())
