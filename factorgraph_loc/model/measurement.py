"""The interface of measurements: frozen values with timestamps in seconds from the start of the log, in SI units."""

from dataclasses import dataclass
from typing import ClassVar, Protocol


class Measurement(Protocol):
    """A measurement at ``t`` [s], the time of the event with the clock offset applied.

    ``sensor``: its channel, as in a log and in ``--sensors``. ``modality``: the kind of sensor, by which estimators declare what
    they use. ``count``: number of detections. ``is_motion``: whether it measures the robot's motion.
    """

    @property
    def t(self) -> float: ...
    @property
    def sensor(self) -> str: ...
    @property
    def modality(self) -> str: ...
    @property
    def count(self) -> int: ...
    @property
    def is_motion(self) -> bool: ...


@dataclass(frozen=True, slots=True)
class Tick:
    """A time at which the causal trajectory is evaluated."""

    sensor: ClassVar[str] = "tick"
    modality: ClassVar[str] = "tick"
    count: ClassVar[int] = 0
    is_motion: ClassVar[bool] = False
    t: float
