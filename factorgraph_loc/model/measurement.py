"""The interface of measurements: frozen values with timestamps in seconds from the start of the log, in SI units."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from factors.se2 import Array


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


def named(m: Measurement) -> str:
    """The measurement in an error: ``BearingRange at 1.500 s``."""
    return f"{type(m).__name__} at {m.t:.3f} s"


@dataclass(frozen=True, slots=True)
class Tick:
    """A time at which the causal trajectory is evaluated."""

    sensor: ClassVar[str] = "tick"
    modality: ClassVar[str] = "tick"
    count: ClassVar[int] = 0
    is_motion: ClassVar[bool] = False
    t: float


@dataclass(frozen=True, slots=True)
class Rows:
    """Measurements of one ``kind`` that follow one another in time, as one: their ``times`` (N,) [s], and their ``values``, an
    array (N,) of each field. As a measurement it has the time of the last."""

    kind: type[Any]
    times: Array
    values: tuple[Array, ...]

    @property
    def t(self) -> float:
        return float(self.times[-1])

    @property
    def sensor(self) -> str:
        return str(self.kind.sensor)

    @property
    def modality(self) -> str:
        return str(self.kind.modality)

    @property
    def count(self) -> int:
        return len(self.times)

    @property
    def is_motion(self) -> bool:
        return bool(self.kind.is_motion)

    def part(self, first: int, last: int) -> "Rows":
        """Those from ``first`` to before ``last``."""
        return Rows(self.kind, self.times[first:last], tuple([values[first:last] for values in self.values]))

    def singly(self) -> Iterator[Measurement]:
        """Each as a measurement of its own."""
        return map(self.kind, self.times.tolist(), *(values.tolist() for values in self.values))
