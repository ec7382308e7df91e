"""The table of measured motion in space."""

from factorgraph_loc.files.columns import FASTEST, FASTEST_TURN, RATE, SPEED, STAMP, Table, within

TWIST = Table(
    "twist",
    (
        STAMP,
        within("v", SPEED, FASTEST, "speed along each axis of the robot"),
        within("w", RATE, FASTEST_TURN, "turn rate about each axis of the robot"),
    ),
    "one each",
    stream="factorgraph_loc.sensors.twist.stream:TwistStream",
)
