"""Measured motion in space."""

from dataclasses import dataclass
from typing import ClassVar

from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class Twist:
    """Motion in space of a robot that is carried: velocity ``v`` (3,) [m/s] and turn rate ``w`` (3,) [rad/s], both in its own
    frame, held until the next row."""

    sensor: ClassVar[str] = "twist"
    modality: ClassVar[str] = "twist"
    is_motion: ClassVar[bool] = True
    count: ClassVar[int] = 1
    t: float
    v: Array
    w: Array
