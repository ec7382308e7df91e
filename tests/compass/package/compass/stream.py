"""Measurement, stream and table of a compass."""

from dataclasses import dataclass
from typing import Any, ClassVar

from factorgraph_loc.files.columns import ANGLE, FULL_TURN, STAMP, Table, within
from factorgraph_loc.model.measurement import Stream
from factors.se2 import Array

HEADINGS = Table(
    "compass",
    (STAMP, within("heading", ANGLE, FULL_TURN, "heading including the compass's bias")),
    stream="compass.stream:HeadingStream",
)


@dataclass(frozen=True, slots=True)
class Heading:
    """The robot's ``heading`` [rad] in the world, including the compass's bias."""

    sensor: ClassVar[str] = "compass"
    modality: ClassVar[str] = "compass"
    is_motion: ClassVar[bool] = False
    count: ClassVar[int] = 1
    t: float
    heading: float
    source: str = modality


@dataclass(frozen=True)
class HeadingStream(Stream):
    """``heading`` (N,) [rad]."""

    kind: ClassVar[type[Any]] = Heading
    heading: Array
