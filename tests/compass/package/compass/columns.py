"""The table of a compass."""

from factorgraph_loc.files.columns import ANGLE, FULL_TURN, STAMP, Table, within

HEADINGS = Table(
    "compass",
    (STAMP, within("heading", ANGLE, FULL_TURN, "direction of the robot's x axis, with the compass's bias")),
    "one each",
    stream="compass.stream:HeadingStream",
)
