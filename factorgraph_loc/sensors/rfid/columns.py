"""The tables of RFID readers and of tags."""

from factorgraph_loc.files.columns import (
    ANGLE,
    DURATION,
    FREQUENCY,
    FULL_TURN,
    LENGTH,
    POWER,
    PURE,
    STAMP,
    Column,
    Table,
    named,
    number,
    within,
)
from factorgraph_loc.files.models import FARTHEST

ANTENNA = named("antenna", "the name of an antenna")
RFID = Table(
    "rfid",
    (
        STAMP,
        ANTENNA,
        named("epc", "the EPC of a tag"),
        number("rssi", POWER, -200.0, 200.0, "strength of the response, by the reader's own zero", may_lack=True),
        number("phase", ANGLE, -FULL_TURN, FULL_TURN, "phase as the reader reports it", may_lack=True),
        number("frequency", FREQUENCY, 1e8, 1e10, "of the carrier", may_lack=True),
        Column("inventory", "whole", PURE, 1.0, 2.0**53, False, "the row of the round in inventories"),
    ),
    "one measurement",
    optional=((("rssi", "phase", "frequency"), ("rssi",), ()), (("inventory",), ())),
)
INVENTORIES = Table(
    "inventories",
    (STAMP, ANTENNA, number("duration", DURATION, 0.0, 3600.0, "duration of the round, which ends at the timestamp")),
    "one measurement",
)
# the reads of a stream or scan, grouped in rounds
READS = Table(
    "reads",
    (
        number("age", DURATION, 0.0, 3600.0, "time from the read to the end of its round"),
        *(RFID[name] for name in ("rssi", "phase", "frequency")),
    ),
    "one measurement",
    stream="factorgraph_loc.sensors.rfid.stream:RfidStream",
)
TAGS = Table(
    "tags",
    (
        named("epc", "the EPC of a tag"),
        within("x", LENGTH, FARTHEST, "position in the frame of the survey"),
        within("y", LENGTH, FARTHEST, "position in the frame of the survey"),
        number("z", LENGTH, -FARTHEST, FARTHEST, "height; 0 if empty", may_lack=True),
        number("facing", ANGLE, -FULL_TURN, FULL_TURN, "direction that its front faces", may_lack=True),
        number("sigma", LENGTH, 0.0, 100.0, "standard deviation of its survey in x and y", may_lack=True),
    ),
    "one each",
)
