"""The streams of wheel odometry and gyro."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.sensors.odometry.measurement import IncrementOdometry, VelocityOdometry, YawRate
from factors.se2 import Array


@dataclass(frozen=True)
class VelocityStream(Stream):
    """``v`` (N,) [m/s] and ``w`` (N,) [rad/s], each held until the next row."""

    rank: ClassVar[int] = 0
    kind: ClassVar[type[Any]] = VelocityOdometry
    joins: ClassVar[bool] = True
    v: Array
    w: Array


@dataclass(frozen=True)
class IncrementStream(Stream):
    """``dx``, ``dy``, ``dtheta`` (N,): motion since the previous row, in the robot frame at that row."""

    rank: ClassVar[int] = 0
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

    rank: ClassVar[int] = 1
    kind: ClassVar[type[Any]] = YawRate
    w: Array
