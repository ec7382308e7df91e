"""What an inertial unit measures: the measurement, its stream, its table, and use by estimators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from factorgraph_loc.files.columns import FASTEST_TURN, RATE, STAMP, Table, within
from factorgraph_loc.model.measurement import Measurement, Stream
from factorgraph_loc.sensors.inertial.settings import InertialSettings
from factors.se2 import Array

if TYPE_CHECKING:
    from factorgraph_loc.model.setup import Setup

FORCE = {"m/s^2": 1.0, "g": 9.80665}
STRONGEST = 1000.0  # m/s^2: shocks stay below 100 g
FORCE_DOC, TURN_DOC = "specific force along the unit's {} axis: up when at rest", "turn rate about the unit's {} axis"
INERTIAL = Table(
    "inertial",
    (
        STAMP,
        *(within(f"a{axis}", FORCE, STRONGEST, FORCE_DOC.format(axis)) for axis in "xyz"),
        *(within(f"w{axis}", RATE, FASTEST_TURN, TURN_DOC.format(axis)) for axis in "xyz"),
    ),
    "one each",
    stream="factorgraph_loc.sensors.inertial.measurement:InertialStream",
)


@dataclass(frozen=True, slots=True)
class Inertial:
    """Specific force ``ax``, ``ay``, ``az`` [m/s^2] and turn rate ``wx``, ``wy``, ``wz`` [rad/s] along the unit's axes."""

    sensor: ClassVar[str] = "inertial"
    modality: ClassVar[str] = "inertial"
    is_motion: ClassVar[bool] = True
    count: ClassVar[int] = 1
    t: float
    ax: float
    ay: float
    az: float
    wx: float
    wy: float
    wz: float

    def values(self) -> Array:
        """Force and turn rate (6,)."""
        return np.array((self.ax, self.ay, self.az, self.wx, self.wy, self.wz))


@dataclass(frozen=True)
class InertialStream(Stream):
    """Specific force ``ax``, ``ay``, ``az`` (N,) [m/s^2] and turn rate ``wx``, ``wy``, ``wz`` (N,) [rad/s]."""

    rank: ClassVar[int] = 1
    kind: ClassVar[type[Any]] = Inertial
    ax: Array
    ay: Array
    az: Array
    wx: Array
    wy: Array
    wz: Array


def inertial(m: Measurement) -> Inertial | None:
    """The measurement if it is an :class:`Inertial`, else None."""
    return m if isinstance(m, Inertial) else None


def inertial_settings(setup: Setup) -> InertialSettings | None:
    """The settings of a run, or None if no inertial unit is used."""
    return setup.rig.find(InertialSettings) if "inertial" in setup.sensors else None
