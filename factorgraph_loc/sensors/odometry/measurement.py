"""Measurements of wheel odometry and gyro."""

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class VelocityOdometry:
    """Forward velocity ``v`` [m/s] and turn rate ``w`` [rad/s], held until the next row."""

    sensor: ClassVar[str] = "odometry"
    modality: ClassVar[str] = "odometry"
    is_motion: ClassVar[bool] = True
    count: ClassVar[int] = 1
    t: float
    v: float
    w: float


@dataclass(frozen=True, slots=True)
class IncrementOdometry:
    """Motion since the previous row: ``dx``, ``dy`` [m] and ``dtheta`` [rad] in the robot frame at the previous row."""

    sensor: ClassVar[str] = "odometry"
    modality: ClassVar[str] = "odometry"
    is_motion: ClassVar[bool] = True
    count: ClassVar[int] = 1
    t: float
    dx: float
    dy: float
    dtheta: float


@dataclass(frozen=True, slots=True)
class YawRate:
    """Turn rate ``w`` [rad/s] of a gyro, held until the next row."""

    sensor: ClassVar[str] = "imu"
    modality: ClassVar[str] = "imu"
    is_motion: ClassVar[bool] = True
    count: ClassVar[int] = 1
    t: float
    w: float
