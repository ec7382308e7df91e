"""The table of identified landmarks."""

from factorgraph_loc.files.columns import ANGLE, FULL_TURN, LENGTH, LONGEST_RANGE, NEAREST, STAMP, Table, named, number

BEARING_RANGE = Table(
    "bearing_range",
    (
        STAMP,
        named("landmark", "the name of a landmark"),
        # radios that got no answer say 0, and gross errors may lie below: no measurement then
        number(
            "range",
            LENGTH,
            -LONGEST_RANGE,
            LONGEST_RANGE,
            "distance; below 0.001 it is left out",
            may_lack=True,
            left_out_below=NEAREST,
        ),
        number("bearing", ANGLE, -FULL_TURN, FULL_TURN, "direction in the sensor's frame", may_lack=True),
    ),
    "one measurement",
    stream="factorgraph_loc.sensors.landmarks.stream:BearingRangeStream",
)
