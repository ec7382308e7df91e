"""The tables of wheel odometry and gyro, and their conversion to streams."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from factorgraph_loc.files import checks
from factorgraph_loc.files.columns import (
    ANGLE,
    FASTEST,
    FASTEST_TURN,
    LENGTH,
    LONGEST_WAY,
    MOST_TURNED,
    RATE,
    SPEED,
    STAMP,
    Table,
    within,
)
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.sensors.odometry.measurement import IncrementStream
from factorgraph_loc.sensors.tables import Reading, stream_of

VELOCITIES = Table(
    "odometry",
    (
        STAMP,
        within("v", SPEED, FASTEST, "forward speed, held until the next row"),
        within("w", RATE, FASTEST_TURN, "turn rate, held until the next row"),
    ),
    "one each",
    stream="factorgraph_loc.sensors.odometry.measurement:VelocityStream",
)
INCREMENTS = Table(
    "odometry",
    (
        STAMP,
        within("dx", LENGTH, LONGEST_WAY, "forward motion since the row before"),
        within("dy", LENGTH, LONGEST_WAY, "motion to the left since the row before"),
        within("dtheta", ANGLE, MOST_TURNED, "rotation since the row before"),
    ),
    "one each",
    stream="factorgraph_loc.sensors.odometry.measurement:IncrementStream",
)
IMU = Table(
    "imu",
    (STAMP, within("w", RATE, FASTEST_TURN, "turn rate of a gyro")),
    "one each",
    stream="factorgraph_loc.sensors.odometry.measurement:YawRateStream",
)
# wheel counters, which are converted to increments
WAYS = Table(
    "odometry",
    (
        STAMP,
        *(
            within(side, LENGTH, 1e9, "distance of that wheel so far; counters have 32 bits")
            for side in ("left", "right")
        ),
    ),
    "one each",
)
# wheels of which speeds or turns are told, which are converted to velocities or increments
WHEELS = Table(
    "odometry",
    (
        STAMP,
        *(within(f"{side}_speed", SPEED, FASTEST, "speed of that wheel") for side in ("left", "right")),
        *(within(f"{side}_angle", ANGLE, 1e9, "how far that wheel turned") for side in ("left", "right")),
        *(within(f"{side}_rate", RATE, 1e4, "how fast that wheel turns") for side in ("left", "right")),
    ),
    "one each",
)


def assemble(rows: Mapping[str, TableRows], reading: Reading) -> Stream:
    """The stream of velocities or increments; rows with equal timestamps are merged."""
    told = rows["odometry"]
    if "dx" not in told.numbers:
        return stream_of(VELOCITIES, told, reading.t0_ns, reading.warnings)
    moves = np.column_stack([told.numbers[column.name] for column in INCREMENTS.columns[1:]])
    t_ns, moves = checks.increments_in_order(told.path, told.rows, told.t_ns, moves, reading.warnings)
    return IncrementStream(checks.seconds(t_ns, reading.t0_ns), *np.ascontiguousarray(moves.T))
