"""What the sensors of a robot report: frozen values, stamped in seconds from the log's start, in SI units.

Stamps are those of the event, with the known offsets between clocks already applied.
"""

from dataclasses import dataclass

from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class VelocityOdometry:
    """Forward velocity ``v`` [m/s] and turn rate ``w`` [rad/s], held until the next row."""

    t: float
    v: float
    w: float


@dataclass(frozen=True, slots=True)
class IncrementOdometry:
    """Motion since the previous row: ``dx``, ``dy`` [m] and ``dtheta`` [rad] in the robot's frame at the previous row."""

    t: float
    dx: float
    dy: float
    dtheta: float


@dataclass(frozen=True, slots=True)
class YawRate:
    """Turn rate ``w`` [rad/s] of a gyro, held until the next row."""

    t: float
    w: float


@dataclass(frozen=True, slots=True)
class BearingRange:
    """Identified landmarks seen at one time.

    ``landmarks``: K names. ``range`` (K,) [m] and ``bearing`` (K,) [rad, in the sensor's frame]: NaN where not measured.
    """

    t: float
    landmarks: tuple[str, ...]
    range: Array
    bearing: Array


@dataclass(frozen=True, slots=True)
class Tick:
    """No measurement: time has passed, and an estimate is wanted."""

    t: float


Odometry = VelocityOdometry | IncrementOdometry | YawRate
Measurement = Odometry | BearingRange | Tick
