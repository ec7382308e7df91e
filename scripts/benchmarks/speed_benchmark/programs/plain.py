"""A log of odometry and landmarks as plain numbers, for programs that know nothing of this project: numpy and the standard
library are all that they need, so that they also run in an environment that has only the package they show.

A program is called with the file of a problem, and prints one line of JSON: see :func:`measured`.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
MOTION, SIGHTING, TICK = range(3)
WARM_UP = 15.0  # s of the log, which are run before the measured run
LEAST_VARIANCE = 1e-8  # of a motion, so that its covariance can be inverted
MAX_GAP = 0.1  # s between neighbours of the reference that a pose is compared with


@dataclass(frozen=True)
class Problem:
    """``start``, ``pose`` (3,), ``covariance`` (3, 3): where the robot is at first, in the world frame. ``moves`` (N, 4): until
    when [s], for how long [s], speed [m/s], turn rate [rad/s]. ``sightings`` (M, 7): when, the landmark's x and y [m], range [m]
    and bearing [rad] from the robot's origin, with their standard deviations. ``raw`` (M, 4): depth and bearing as the sensor
    reports them, with their standard deviations. ``ticks`` (K,): when the pose is asked for. ``growth`` (4,): variances of the
    motion, along and across per m, of the heading per m and per rad. ``sensor`` (2,): how far in front of the robot's origin the
    sensor is, and its scale. ``constants`` (5,): standard deviations of the gyro's bias [rad/s], and of the sensor's place [m],
    bearing bias [rad], scale and depth axis [rad]. ``reference_t`` (R,), ``reference`` (R, 3): true poses."""

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

    def save(self, path: Path) -> None:
        """Write it as an npz file."""
        with path.open("wb") as file:
            np.savez(file, **{f.name: getattr(self, f.name) for f in fields(self)})

    def until(self, seconds: float) -> Problem:
        """The first ``seconds``."""
        end = self.start + seconds
        seen = self.sightings[:, 0] <= end
        moves, ticks = self.moves[self.moves[:, 0] <= end], self.ticks[self.ticks <= end]
        cut = {"moves": moves, "ticks": ticks, "sightings": self.sightings[seen], "raw": self.raw[seen]}
        whole = {f.name: getattr(self, f.name) for f in fields(self)}
        return Problem(**{**whole, **cut})

    def events(self, *, raw: bool = False) -> list[tuple[int, float, Any]]:
        """(kind, time, what): for a motion (duration, speed, turn rate); for a stamp with landmarks a list of (x, y, range,
        bearing, their standard deviations), or with ``raw`` as the sensor reports them; for a tick None."""
        made: list[tuple[int, float, Any]] = [(MOTION, t, tuple(rest)) for t, *rest in self.moves.tolist()]
        rows: dict[float, list[tuple[float, ...]]] = {}
        seen = np.column_stack((self.sightings[:, :3], self.raw)) if raw else self.sightings
        for t, *rest in seen.tolist():
            rows.setdefault(t, []).append(tuple(rest))
        made += [(SIGHTING, t, seen) for t, seen in rows.items()]
        made += [(TICK, t, None) for t in self.ticks.tolist()]
        return sorted(made, key=lambda event: (event[1], event[0]))

    def rmse(self, t: list[float], poses: list[Any]) -> tuple[float, float]:
        """Root mean square errors of position [m] and heading [rad], where the reference is dense."""
        stamps, found = np.array(t), np.array(poses, dtype=float)
        i = np.clip(np.searchsorted(self.reference_t, stamps, side="right"), 1, len(self.reference_t) - 1)
        before, after = self.reference[i - 1], self.reference[i]
        gap = self.reference_t[i] - self.reference_t[i - 1]
        part = (stamps - self.reference_t[i - 1]) / gap
        inside = (stamps >= self.reference_t[0]) & (stamps <= self.reference_t[-1]) & (gap <= MAX_GAP + 1e-9)
        true = before[:, :2] + part[:, None] * (after - before)[:, :2]
        heading = before[:, 2] + part * wrapped(after[:, 2] - before[:, 2])
        off = np.hypot(*(found[:, :2] - true).T)[inside]
        turned = wrapped(found[:, 2] - heading)[inside]
        return float(np.sqrt(np.mean(off**2))), float(np.sqrt(np.mean(turned**2)))


def read_problem(path: Path) -> Problem:
    """The problem that :meth:`Problem.save` wrote."""
    with np.load(path) as data:
        known: dict[str, Any] = {name: data[name] if data[name].ndim else float(data[name]) for name in data}
    return Problem(**known)


def wrapped(angle: Any) -> Any:
    """An angle, or several, within half a turn."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def composed(pose: tuple[float, float, float], move: tuple[float, float, float]) -> tuple[float, float, float]:
    """The pose after a motion in its own frame."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return pose[0] + c * move[0] - s * move[1], pose[1] + s * move[0] + c * move[1], wrapped(pose[2] + move[2])


def turned(covariance: Array, heading: float) -> Array:
    """The covariance (3, 3) of a pose in a frame that is turned by ``heading``."""
    c, s = math.cos(heading), math.sin(heading)
    rotation = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))
    return np.asarray(rotation @ covariance @ rotation.T)


class Motion:
    """The motion since it was last taken, in the frame of the pose then."""

    __slots__ = ("growth", "h", "path", "turn", "x", "y")

    def __init__(self, growth: Array) -> None:
        self.growth: tuple[float, ...] = tuple(growth.tolist())
        self.x = self.y = self.h = self.path = self.turn = 0.0

    def add(self, duration: float, speed: float, rate: float) -> None:
        """Go on with a speed and a turn rate."""
        change, way = rate * duration, speed * duration
        middle = self.h + 0.5 * change
        self.x += way * math.cos(middle)
        self.y += way * math.sin(middle)
        self.h += change
        self.path += abs(way)
        self.turn += abs(change)

    def so_far(self) -> tuple[float, float, float]:
        """Where the robot is."""
        return self.x, self.y, self.h

    def take(self) -> tuple[float, float, float, Array]:
        """Where the robot is, with the covariance (3, 3) of that in its frame there; what comes next starts from there."""
        x, y, h, path, turn = self.x, self.y, self.h, self.path, self.turn
        self.x = self.y = self.h = self.path = self.turn = 0.0
        along, across = self.growth[0] * path, self.growth[1] * path
        heading = self.growth[2] * path + self.growth[3] * turn
        c, s = math.cos(h), math.sin(h)
        nx, ny = (
            s * x - c * y,
            c * x + s * y,
        )  # the end seen from its start, turned: an error of the heading moves it there
        a, b = math.cos(h / 2.0), -math.sin(h / 2.0)
        xy = a * b * (along - across) + heading * nx * ny / 3.0
        xh, yh = heading * nx / 2.0, heading * ny / 2.0
        xx = a * a * along + b * b * across + heading * nx * nx / 3.0 + LEAST_VARIANCE
        yy = b * b * along + a * a * across + heading * ny * ny / 3.0 + LEAST_VARIANCE
        return x, y, h, np.array(((xx, xy, xh), (xy, yy, yh), (xh, yh, heading + LEAST_VARIANCE)))


@dataclass
class Found:
    """What a loop estimated: poses at stamps; ``updates``: processor time of each stamp with landmarks [s]."""

    t: list[float] = field(default_factory=list)
    poses: list[Any] = field(default_factory=list)
    updates: list[float] = field(default_factory=list)


Loop = Callable[[Problem], Found]


def measured(problem: Problem, loop: Loop) -> dict[str, float]:
    """Processor time of a loop [s], the median, the 99th percentile, and that of the first and of the last quarter of its updates
    [us], and its errors [m, rad]."""
    loop(problem.until(WARM_UP))
    started = time.process_time()
    found = loop(problem)
    seconds = time.process_time() - started
    position, heading = problem.rmse(found.t, found.poses)
    return {"seconds": seconds, **quantiles(found.updates), "position": position, "heading": heading}


def quantiles(updates: list[float]) -> dict[str, float]:
    """Of processor times [s], in us."""
    if not updates:
        return {}
    us, quarter = 1e6 * np.array(updates), max(1, len(updates) // 4)
    first, last = float(np.median(us[:quarter])), float(np.median(us[-quarter:]))
    return {"median": float(np.median(us)), "p99": float(np.percentile(us, 99.0)), "first": first, "last": last}


def command(loops: dict[str, Loop]) -> None:
    """``PROGRAM PROBLEM LOOP``: measure one of the loops, and print what was found."""
    path, name = sys.argv[1:]
    print(json.dumps(measured(read_problem(Path(path)), loops[name])))
