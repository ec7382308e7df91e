"""A logged run: rig, world, measurements by sensor, and the reference trajectory if there is one."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import numpy as np

from factorgraph_loc.measurements import BearingRange, IncrementOdometry, Measurement, VelocityOdometry, YawRate
from factorgraph_loc.rig import Rig
from factorgraph_loc.trajectory import Trajectory
from factorgraph_loc.world import World
from factors.se2 import Array


class Stream(Protocol):
    """The rows of one sensor, as arrays; ``t`` (N,) in seconds from the log's start, by the sensor's own clock.

    Rows stand in the order in which they arrived; a stamp may be a little older than the one before (a late measurement).
    """

    @property
    def t(self) -> Array: ...

    def measurements(self, offset: float) -> Iterator[Measurement]: ...


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


@dataclass(frozen=True)
class BearingRangeStream:
    """One row a landmark: its name, range [m] and bearing [rad] (NaN where not measured). Rows of one stamp belong together."""

    t: Array
    landmark: Sequence[str]
    range: Array
    bearing: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        bounds = [*np.flatnonzero(np.diff(self.t, prepend=np.nan) != 0.0).tolist(), len(self.t)]
        for i, j in pairwise(bounds):
            yield BearingRange(float(self.t[i]) + offset, tuple(self.landmark[i:j]), self.range[i:j], self.bearing[i:j])


@dataclass(frozen=True)
class StartPose:
    """A known start: ``t`` [s], ``pose`` (3,) and standard deviations (3,) of x, y, heading."""

    t: float
    pose: Array
    sigmas: Array


@dataclass(frozen=True)
class Log:
    """A run. ``streams`` by sensor name (odometry, imu, bearing_range); ``t0_ns``: absolute time of t = 0 in nanoseconds.

    ``warnings``: what the reader mended or left out, one line each. ``metadata``: licence, origin and the like.
    """

    name: str
    rig: Rig
    world: World
    streams: Mapping[str, Stream]
    reference: Trajectory | None = None
    start: StartPose | None = None
    t0_ns: int = 0
    warnings: tuple[str, ...] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)

    def span(self) -> tuple[float, float]:
        """First and last stamp of all streams [s]."""
        stamps = [(s.t.min(), s.t.max()) for s in self.streams.values() if len(s.t)]
        if not stamps:
            return 0.0, 0.0
        return float(min(a for a, _ in stamps)), float(max(b for _, b in stamps))

    def measurements(self, sensors: Sequence[str]) -> Iterator[Measurement]:
        """The measurements of ``sensors`` in the order in which they arrived, stamps corrected by the rig's offsets.

        A late one keeps its stamp and follows those that arrived before it. At equal times odometry comes first.
        """

        def arrivals(rank: int, name: str) -> Iterator[tuple[float, int, int, Measurement]]:
            latest = -np.inf
            for i, m in enumerate(self.streams[name].measurements(self.rig.time_offset(name))):
                latest = max(latest, m.t)
                yield latest, rank, i, m

        order = sorted((s for s in self.streams if s in sensors), key=lambda s: (s != "odometry", s != "imu", s))
        for _, _, _, m in heapq.merge(*(arrivals(rank, name) for rank, name in enumerate(order))):
            yield m
