"""Measurements of wheel odometry and gyro, their streams, and validation of what is pushed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.measurement import FLOOR, TURN, Measurement, Stream, named
from factors.se2 import Array

if TYPE_CHECKING:
    from factorgraph_loc.model.rig import Rig
    from factorgraph_loc.model.world import World


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


@dataclass(frozen=True)
class VelocityStream(Stream):
    """``v`` (N,) [m/s] and ``w`` (N,) [rad/s], each held until the next row."""

    rank: ClassVar[int] = FLOOR
    kind: ClassVar[type[Any]] = VelocityOdometry
    joins: ClassVar[bool] = True
    v: Array
    w: Array


@dataclass(frozen=True)
class IncrementStream(Stream):
    """``dx``, ``dy``, ``dtheta`` (N,): motion since the previous row, in the robot frame at that row."""

    rank: ClassVar[int] = FLOOR
    kind: ClassVar[type[Any]] = IncrementOdometry
    dx: Array
    dy: Array
    dtheta: Array

    def begun_anew(self) -> IncrementStream:
        """The stream with a first increment of zero, because wheels do not measure how the robot is carried."""
        moves = np.arange(len(self.t)) > 0
        return replace(self, dx=self.dx * moves, dy=self.dy * moves, dtheta=self.dtheta * moves)


@dataclass(frozen=True)
class YawRateStream(Stream):
    """``w`` (N,) [rad/s] of a gyro."""

    rank: ClassVar[int] = TURN
    kind: ClassVar[type[Any]] = YawRate
    w: Array


class Increments:
    """Checks that increments are in order of time."""

    def __init__(self, rig: Rig, world: World) -> None:
        self._newest = -math.inf

    def require(self, m: Measurement) -> None:
        """InputError for an increment that goes back in time."""
        if not isinstance(m, IncrementOdometry):
            return
        if m.t < self._newest:
            raise InputError(f"{named(m)}: follows one at {self._newest:.3f} s, expected increments in order of time")
        self._newest = m.t
