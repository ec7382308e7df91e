"""Measured motion in space."""

from dataclasses import dataclass
from typing import ClassVar

from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class Twist:
    """Three-dimensional motion: velocity ``v`` (3,) [m/s] and turn rate ``w`` (3,) [rad/s] in the robot frame, held until the next
    row."""

    sensor: ClassVar[str] = "twist"
    modality: ClassVar[str] = "twist"
    is_motion: ClassVar[bool] = True
    count: ClassVar[int] = 1
    t: float
    v: Array
    w: Array
