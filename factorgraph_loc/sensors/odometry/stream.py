"""The rows of wheel odometry and gyro."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.stream import Stream
from factorgraph_loc.sensors.odometry.measurement import IncrementOdometry, VelocityOdometry, YawRate
from factors.se2 import Array


@dataclass(frozen=True)
class VelocityStream(Stream):
    """``v`` (N,) [m/s] and ``w`` (N,) [rad/s], each held until the next row."""

    rank: ClassVar[int] = 0
    v: Array
    w: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        return map(VelocityOdometry, (self.t + offset).tolist(), self.v.tolist(), self.w.tolist())


@dataclass(frozen=True)
class IncrementStream(Stream):
    """``dx``, ``dy``, ``dtheta`` (N,): motion since the previous row, in the robot's frame at that row."""

    rank: ClassVar[int] = 0
    dx: Array
    dy: Array
    dtheta: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        columns = ((self.t + offset).tolist(), self.dx.tolist(), self.dy.tolist(), self.dtheta.tolist())
        return map(IncrementOdometry, *columns)

    def begun_anew(self) -> IncrementStream:
        """The same with a first increment of zero: wheels do not feel how they are carried."""
        moves = np.arange(len(self.t)) > 0
        return replace(self, dx=self.dx * moves, dy=self.dy * moves, dtheta=self.dtheta * moves)


@dataclass(frozen=True)
class YawRateStream(Stream):
    """``w`` (N,) [rad/s] of a gyro."""

    rank: ClassVar[int] = 1
    w: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        return map(YawRate, (self.t + offset).tolist(), self.w.tolist())
