"""What the sensors of a robot report: frozen values, stamped in seconds from the log's start, in SI units."""

from dataclasses import dataclass
from typing import ClassVar, Protocol


class Measurement(Protocol):
    """What a sensor reported at ``t`` [s], the time of the event, with the known offset between clocks already applied.

    ``sensor``: the channel that it is of, as a log and ``--sensors`` name it; ``modality``: the kind of sensor, by which estimators
    say what they use; ``count``: how many things were seen; ``is_motion``: whether it tells how the robot moves.
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
    """No measurement: time has passed, and the trajectory is wanted at this stamp."""

    sensor: ClassVar[str] = "tick"
    modality: ClassVar[str] = "tick"
    count: ClassVar[int] = 0
    is_motion: ClassVar[bool] = False
    t: float
