"""Measurements of wheel odometry and gyro: their types, the columns of their files, and checks of live measurements."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.columns import (
    ANGLE,
    DURATION,
    FASTEST,
    FASTEST_TURN,
    LENGTH,
    LONGEST_WAY,
    MAX_SPAN,
    MOST_TURNED,
    RATE,
    SPEED,
    STAMP,
    Table,
    number,
    within,
)
from factorgraph_loc.model.measurement import FLOOR, TURN, Measurement, Stream, columns_of, named
from factorgraph_loc.sensors.tables import Columns, Intake, Reading, Writing, stream_of
from factors.se2 import Array, Integers

if TYPE_CHECKING:
    from factorgraph_loc.files.tables import TableRows
    from factorgraph_loc.model.rig import Rig
    from factorgraph_loc.model.world import World


@dataclass(frozen=True, slots=True)
class VelocityOdometry:
    """Forward velocity ``v`` [m/s] and turn rate ``w`` [rad/s] from the time ``t`` [s] until the next measurement."""

    sensor: ClassVar[str] = "odometry"
    modality: ClassVar[str] = "odometry"
    source: ClassVar[str] = "odometry"
    is_motion: ClassVar[bool] = True
    count: ClassVar[int] = 1
    t: float
    v: float
    w: float


@dataclass(frozen=True, slots=True)
class IncrementOdometry:
    """Motion of the robot since the previous measurement.

    ``dx``, ``dy`` [m], ``dtheta`` [rad]: the motion in the robot frame of the previous measurement. ``unknown`` [s]:
    time without measured motion since the previous measurement.
    """

    sensor: ClassVar[str] = "odometry"
    modality: ClassVar[str] = "odometry"
    source: ClassVar[str] = "odometry"
    is_motion: ClassVar[bool] = True
    count: ClassVar[int] = 1
    t: float
    dx: float
    dy: float
    dtheta: float
    unknown: float = 0.0


@dataclass(frozen=True, slots=True)
class YawRate:
    """Turn rate ``w`` [rad/s] of a gyro from the time ``t`` [s] until the next measurement."""

    sensor: ClassVar[str] = "imu"
    modality: ClassVar[str] = "imu"
    source: ClassVar[str] = "imu"
    is_motion: ClassVar[bool] = True
    count: ClassVar[int] = 1
    t: float
    w: float


@dataclass(frozen=True)
class VelocityStream(Stream):
    """All velocities of a log: ``v`` (N,) [m/s] and ``w`` (N,) [rad/s]. Each row is valid until the next row."""

    rank: ClassVar[int] = FLOOR
    kind: ClassVar[type[Any]] = VelocityOdometry
    joins: ClassVar[bool] = True
    v: Array
    w: Array


@dataclass(frozen=True)
class IncrementStream(Stream):
    """All N odometry increments of a log. ``dx``, ``dy`` (N,) [m], ``dtheta`` (N,) [rad]: the motion since the previous
    row, in the robot frame at that row. ``unknown`` (N,) [s]: the time without measured motion since the previous
    row."""

    rank: ClassVar[int] = FLOOR
    kind: ClassVar[type[Any]] = IncrementOdometry
    dx: Array
    dy: Array
    dtheta: Array
    unknown: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not len(self.unknown):
            object.__setattr__(self, "unknown", np.zeros(len(self.t)))

    def without_first_motion(self) -> IncrementStream:
        """Return a copy with a first increment of zero. Use this if the robot was carried before the first row."""
        moves = np.arange(len(self.t)) > 0
        return replace(
            self, dx=self.dx * moves, dy=self.dy * moves, dtheta=self.dtheta * moves, unknown=self.unknown * moves
        )


@dataclass(frozen=True)
class YawRateStream(Stream):
    """All turn rates ``w`` (N,) [rad/s] of a gyro in a log. Each row is valid until the next row."""

    rank: ClassVar[int] = TURN
    kind: ClassVar[type[Any]] = YawRate
    w: Array


class Increments(Intake):
    """Checks that the increments that a program passes to the live localizer are in order of time."""

    def __init__(self, rig: Rig, world: World) -> None:
        self._newest = -math.inf

    def require(self, m: Measurement) -> None:
        if not isinstance(m, IncrementOdometry):
            return
        if m.t < self._newest:
            raise InputError(
                f"{named(m)}: follows an increment at {self._newest:.3f} s, expected increments in order of time"
            )
        self._newest = m.t


VELOCITIES = Table(
    "odometry",
    (
        STAMP,
        within("v", SPEED, FASTEST, "forward speed, held until the next row"),
        within("w", RATE, FASTEST_TURN, "turn rate, held until the next row"),
    ),
    stream="factorgraph_loc.sensors.odometry.measurement:VelocityStream",
)
INCREMENTS = Table(
    "odometry",
    (
        STAMP,
        within("dx", LENGTH, LONGEST_WAY, "forward motion since the previous row"),
        within("dy", LENGTH, LONGEST_WAY, "motion to the left since the previous row"),
        within("dtheta", ANGLE, MOST_TURNED, "rotation since the previous row"),
        number("unknown", DURATION, 0.0, MAX_SPAN, "time of unknown motion since the previous row"),
    ),
    optional=(("unknown",),),
    stream="factorgraph_loc.sensors.odometry.measurement:IncrementStream",
)
IMU = Table(
    "imu",
    (STAMP, within("w", RATE, FASTEST_TURN, "turn rate of a gyro")),
    stream="factorgraph_loc.sensors.odometry.measurement:YawRateStream",
)
# columns of foreign files with wheel distances; a reader converts them to increments
WAYS = Table(
    "odometry",
    (
        STAMP,
        *(within(side, LENGTH, 1e9, "distance that the wheel has travelled so far") for side in ("left", "right")),
    ),
)
# columns of foreign files with wheel speeds or rotations; a reader converts them to velocities or increments
WHEELS = Table(
    "odometry",
    (
        STAMP,
        *(within(f"{side}_speed", SPEED, FASTEST, "speed of the wheel") for side in ("left", "right")),
        *(within(f"{side}_angle", ANGLE, 1e9, "rotation of the wheel") for side in ("left", "right")),
        *(within(f"{side}_rate", RATE, 1e4, "turn rate of the wheel") for side in ("left", "right")),
    ),
)


def since_skipped(t_ns: Integers, resumed: NDArray[np.bool_]) -> Array:
    """Return the durations (N,) [s] of unknown motion before each of N rows of odometry.

    ``t_ns`` (N,): the timestamps of the rows [ns]. ``resumed`` (N,): True for rows that follow a skipped row. The
    motion before these rows is unknown since the previous timestamp. All other durations are 0.
    """
    return np.asarray(resumed * np.maximum(np.diff(t_ns, prepend=t_ns[:1]), 0) / 1e9)


def disassemble(stream: Stream, writing: Writing) -> dict[str, Columns]:
    """Return the columns of the table "odometry" by name. The column ``unknown`` is omitted if all its values are 0.
    ``writing``: the time origin."""
    fields = {name: values for name, values in columns_of(stream).items() if name not in ("t", "unknown")}
    if isinstance(stream, IncrementStream) and stream.unknown.any():
        fields["unknown"] = stream.unknown
    return {"odometry": {STAMP.name: checks.absolute(stream.t, writing.t0_ns), **fields}}


def assemble(rows: Mapping[str, TableRows], reading: Reading) -> Stream:
    """Return the rows of the table "odometry" as a stream of velocities or increments. If timestamps are equal,
    increments are composed, and the last velocity is kept. ``rows``: the rows by table name. ``reading``: the time
    origin, and a list to append warnings to."""
    table = rows["odometry"]
    if "dx" not in table.numbers:
        return stream_of(VELOCITIES, table, reading.t0_ns, reading.warnings)
    moves = np.column_stack([table.numbers[column.name] for column in INCREMENTS.columns[1:4]])
    lost = table.numbers.get("unknown", np.zeros(len(table.rows)))
    moves = np.column_stack((moves, np.maximum(lost, since_skipped(table.t_ns, table.resumed))))
    t_ns, moves = checks.increments_in_order(table.path, table.rows, table.t_ns, moves, reading.warnings, table.rules)
    return IncrementStream(checks.seconds(t_ns, reading.t0_ns), *np.ascontiguousarray(moves.T))
