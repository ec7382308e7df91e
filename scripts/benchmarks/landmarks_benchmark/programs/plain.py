"""A log of odometry and landmarks as plain numbers, for programs that do not depend on this project."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
MOTION, SIGHTING, TICK = range(3)
LEAST_VARIANCE = 1e-8  # added to the covariance of a motion, so that it can be inverted
MAX_GAP = 0.1  # s: the reference is not interpolated between poses that are farther apart


@dataclass(frozen=True)
class Problem:
    """A log with odometry and landmarks as arrays.

    ``start`` [s], ``pose`` (3,), ``covariance`` (3, 3): the start, in the world frame.
    ``moves`` (N, 4): motions, each with end [s], duration [s], speed [m/s] and turn rate [rad/s].
    ``sightings`` (M, 7): measurements of landmarks. Columns: time [s], x and y of the landmark [m], range [m] and bearing [rad]
    from the robot's origin, and their standard deviations.
    ``raw`` (M, 4): the same measurements as reported by the sensor: depth [m], bearing [rad], and their standard deviations.
    ``ticks`` (K,) [s]: the times at which the pose is estimated.
    ``growth`` (4,): variances of the motion along and across, per m; of the heading, per m and per rad.
    ``sensor`` (2,): x of the sensor in the robot's frame [m], and its scale.
    ``constants`` (5,): standard deviations of the gyro's bias [rad/s], and of the sensor's x [m], bearing bias [rad], scale and
    depth axis [rad]. ``reference_t`` (R,) [s], ``reference`` (R, 3): the true poses.
    """

    start: float
    pose: Array
    covariance: Array
    moves: Array
    sightings: Array
    raw: Array
    ticks: Array
    growth: Array
    sensor: Array
    constants: Array
    reference_t: Array
    reference: Array

    def events(self, *, raw: bool = False) -> list[tuple[int, float, Any]]:
        """Return all events in order of time, as (kind, time, content).

        The content of a motion is (duration, speed, turn rate). That of a measurement of landmarks is a list of (x, y, range,
        bearing, and their standard deviations). That of a tick is None. ``raw``: use the values that the sensor reports.
        """
        made: list[tuple[int, float, Any]] = [(MOTION, t, tuple(rest)) for t, *rest in self.moves.tolist()]
        rows: dict[float, list[tuple[float, ...]]] = {}
        seen = np.column_stack((self.sightings[:, :3], self.raw)) if raw else self.sightings
        for t, *rest in seen.tolist():
            rows.setdefault(t, []).append(tuple(rest))
        made += [(SIGHTING, t, seen) for t, seen in rows.items()]
        made += [(TICK, t, None) for t in self.ticks.tolist()]
        return sorted(made, key=lambda event: (event[1], event[0]))

    def position_rmse(self, t: Any, poses: Any) -> float:
        """Return the root mean square position error [m] of ``poses`` at the times ``t``. Times in gaps of the reference are left
        out."""
        stamps, found = np.array(t), np.array(poses, dtype=float)
        i = np.clip(np.searchsorted(self.reference_t, stamps, side="right"), 1, len(self.reference_t) - 1)
        gap = self.reference_t[i] - self.reference_t[i - 1]
        inside = (stamps >= self.reference_t[0]) & (stamps <= self.reference_t[-1]) & (gap <= MAX_GAP + 1e-9)
        true = [np.interp(stamps, self.reference_t, self.reference[:, axis]) for axis in (0, 1)]
        return float(np.sqrt(np.mean(np.sum((found[:, :2] - np.transpose(true))[inside] ** 2, axis=1))))


def wrapped(angle: Any) -> Any:
    """Return angles [rad], wrapped to the interval from -pi to pi."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def composed(pose: tuple[float, float, float], move: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return ``pose`` after the motion ``move``, which is given in the frame of ``pose``."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return pose[0] + c * move[0] - s * move[1], pose[1] + s * move[0] + c * move[1], wrapped(pose[2] + move[2])


def turned(covariance: Array, heading: float) -> Array:
    """Return the covariance (3, 3) of a pose in a frame that is turned by ``heading`` [rad]."""
    c, s = math.cos(heading), math.sin(heading)
    rotation = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))
    return np.asarray(rotation @ covariance @ rotation.T)


class Motion:
    """Accumulates motion with its covariance. :meth:`take` returns the motion since its last call."""

    __slots__ = ("growth", "h", "path", "turn", "x", "y")

    def __init__(self, growth: Array) -> None:
        self.growth: tuple[float, ...] = tuple(growth.tolist())
        self.x = self.y = self.h = self.path = self.turn = 0.0

    def add(self, duration: float, speed: float, rate: float) -> None:
        """Add a motion with constant speed [m/s] and turn rate [rad/s]."""
        change, way = rate * duration, speed * duration
        middle = self.h + 0.5 * change
        self.x += way * math.cos(middle)
        self.y += way * math.sin(middle)
        self.h += change
        self.path += abs(way)
        self.turn += abs(change)

    def so_far(self) -> tuple[float, float, float]:
        """Return the accumulated motion: x, y and heading."""
        return self.x, self.y, self.h

    def take(self) -> tuple[float, float, float, Array]:
        """Return the accumulated motion as x, y, heading, and its covariance (3, 3) in the frame of its end. Resets the motion to
        zero."""
        x, y, h, path, turn = self.x, self.y, self.h, self.path, self.turn
        self.x = self.y = self.h = self.path = self.turn = 0.0
        along, across = self.growth[0] * path, self.growth[1] * path
        heading = self.growth[2] * path + self.growth[3] * turn
        c, s = math.cos(h), math.sin(h)
        # derivative of the position by the heading at the start, in the frame of the end
        nx, ny = s * x - c * y, c * x + s * y
        a, b = math.cos(h / 2.0), -math.sin(h / 2.0)
        xy = a * b * (along - across) + heading * nx * ny / 3.0
        xh, yh = heading * nx / 2.0, heading * ny / 2.0
        xx = a * a * along + b * b * across + heading * nx * nx / 3.0 + LEAST_VARIANCE
        yy = b * b * along + a * a * across + heading * ny * ny / 3.0 + LEAST_VARIANCE
        return x, y, h, np.array(((xx, xy, xh), (xy, yy, yh), (xh, yh, heading + LEAST_VARIANCE)))


@dataclass
class Found:
    """The result of a program. ``t`` [s], ``poses``: estimates at the ticks. ``updates`` [s]: processor time of each measurement of
    landmarks."""

    t: list[float] = field(default_factory=list)
    poses: list[Any] = field(default_factory=list)
    updates: list[float] = field(default_factory=list)


Loop = Callable[[Problem], Found]
