"""Measured motion in space: the measurement, its stream, its table, validation of what is pushed, and use by estimators."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from factorgraph_loc.files.columns import FASTEST, FASTEST_TURN, RATE, SPEED, STAMP, Table, within
from factorgraph_loc.files.values import within as checked
from factorgraph_loc.model.measurement import Measurement, Stream
from factorgraph_loc.sensors.twist.settings import TwistSettings
from factors.se2 import Array

if TYPE_CHECKING:
    from factorgraph_loc.model.setup import Setup

TWIST = Table(
    "twist",
    (
        STAMP,
        within("v", SPEED, FASTEST, "speed along each axis of the robot"),
        within("w", RATE, FASTEST_TURN, "turn rate about each axis of the robot"),
    ),
    "one each",
    stream="factorgraph_loc.sensors.twist.measurement:TwistStream",
)


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


@dataclass(frozen=True)
class TwistStream(Stream):
    """``v`` (N, 3) [m/s] and ``w`` (N, 3) [rad/s] in the robot frame, each held until the next row."""

    rank: ClassVar[int] = 1
    v: Array
    w: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        return map(Twist, (self.t + offset).tolist(), self.v, self.w)


def check(m: Twist, where: str) -> dict[str, Any]:
    """The fields of a measurement, with three axes each; InputError names the first invalid one."""
    return {name: checked(where, TWIST[name], getattr(m, name), (3,)) for name in ("v", "w")}


def in_space(m: Measurement) -> Twist | None:
    """The measurement if it is a :class:`Twist`, else None."""
    return m if isinstance(m, Twist) else None


def twist_settings(setup: Setup) -> TwistSettings | None:
    """The settings of a run, or None if motion in space is not used."""
    return setup.rig.find(TwistSettings) if "twist" in setup.sensors else None
