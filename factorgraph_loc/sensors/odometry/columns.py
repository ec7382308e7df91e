"""The tables of wheel odometry and gyro."""

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

VELOCITIES = Table(
    "odometry",
    (
        STAMP,
        within("v", SPEED, FASTEST, "forward speed, held until the next row"),
        within("w", RATE, FASTEST_TURN, "turn rate, held until the next row"),
    ),
    "one each",
    stream="factorgraph_loc.sensors.odometry.stream:VelocityStream",
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
    stream="factorgraph_loc.sensors.odometry.stream:IncrementStream",
)
IMU = Table(
    "imu",
    (STAMP, within("w", RATE, FASTEST_TURN, "turn rate of a gyro")),
    "one each",
    stream="factorgraph_loc.sensors.odometry.stream:YawRateStream",
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
