"""The table of identified landmarks."""

from factorgraph_loc.files.columns import ANGLE, FULL_TURN, LENGTH, LONGEST_RANGE, NEAREST, STAMP, Table, named, number

BEARING_RANGE = Table(
    "bearing_range",
    (
        STAMP,
        named("landmark", "the name of a landmark"),
        # radios report 0 without an answer, and gross errors may be negative: these are missing values
        number(
            "range",
            LENGTH,
            -LONGEST_RANGE,
            LONGEST_RANGE,
            "distance; a value below 0.001 is skipped",
            may_lack=True,
            left_out_below=NEAREST,
        ),
        number("bearing", ANGLE, -FULL_TURN, FULL_TURN, "direction in the sensor frame", may_lack=True),
    ),
    "one measurement",
    stream="factorgraph_loc.sensors.landmarks.stream:BearingRangeStream",
)
