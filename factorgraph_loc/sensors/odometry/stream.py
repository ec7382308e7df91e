"""The rows of wheel odometry and gyro."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.sensors.odometry.measurement import IncrementOdometry, VelocityOdometry, YawRate
from factors.se2 import Array


@dataclass(frozen=True)
class VelocityStream:
    """``v`` (N,) [m/s] and ``w`` (N,) [rad/s], each held until the next row."""

    t: Array
    v: Array
    w: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        return map(VelocityOdometry, (self.t + offset).tolist(), self.v.tolist(), self.w.tolist())


@dataclass(frozen=True)
class IncrementStream:
    """``dx``, ``dy``, ``dtheta`` (N,): motion since the previous row, in the robot's frame at that row."""

    t: Array
    dx: Array
    dy: Array
    dtheta: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        columns = ((self.t + offset).tolist(), self.dx.tolist(), self.dy.tolist(), self.dtheta.tolist())
        return map(IncrementOdometry, *columns)


@dataclass(frozen=True)
class YawRateStream:
    """``w`` (N,) [rad/s] of a gyro."""

    t: Array
    w: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        return map(YawRate, (self.t + offset).tolist(), self.w.tolist())
