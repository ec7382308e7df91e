"""A small folder of other programs' tables, with its manifest, for the tests of reading by a mapping."""

import pytest

ODOMETRY = "time_ms;speed;turn\n1000;1,8;90\n1500;1,8;0\n2500;0;0\n"
READS = """\
// Antennas connected = 1,2
// Timestamp, EPC, TID, Antenna, RSSI, Frequency, Hostname, PhaseAngle, DopplerFrequency, CRHandle
1970-01-01T01:00:01.1000000+01:00,e2001,,1,-60.5,866.3,reader,1.5,0,
1970-01-01T01:00:01.2000000+01:00,e2002,,2,-70,866.3,reader,0.5,0,
1970-01-01T01:00:02.1000005+01:00,e2001,,1,-61,867.5,reader,,0,
"""
TRUTH = "stamp,east,north,yaw\n1,100,0,0\n2,200,0,90\n"
MANIFEST = """\
title = "a hall"
reader = "mapped"
path = "run"
licence = "none stated"
origin = "made by hand"

[options.odometry]
file = "wheels.csv"
separator = ";"
decimal = ","
columns = { t = "time_ms", v = "speed", w = "turn" }
units = { t = "ms", v = "km/h", w = "deg/s" }

[options.rfid]
file = "reads.csv"
preset = "impinj_itemtest"
epc_case = "upper"
antennas = { 1 = "left", 2 = "right" }

[options.reference]
file = "truth.csv"
columns = { t = "stamp", x = "east", y = "north", heading = "yaw" }
units = { t = "s", x = "cm", y = "cm", heading = "deg" }
"""
HEAD = MANIFEST.partition("[options")[0]
VELOCITIES = """
[options.odometry]
file = "wheels.csv"
columns = { t = "t", v = "v", w = "w" }
units = { t = "s" }
"""
WHEELS = """
[options.odometry]
file = "wheels.csv"
separator = ";"
decimal = ","
columns = { t = "time_ms", v = "speed", w = "turn" }
units = { t = "ms" }
"""


def write_mapped(folder, options, **tables):
    """A manifest with these options, and beside it a folder with tables, each a text by the name of its file."""
    (folder / "run").mkdir(exist_ok=True)
    for name, text in tables.items():
        (folder / "run" / f"{name}.csv").write_text(text)
    (folder / "hall.toml").write_text(HEAD + options)
    return folder / "hall.toml"


@pytest.fixture
def hall(tmp_path):
    """A manifest with its folder: odometry of a spreadsheet, ItemTest's reads, a reference in centimetres."""
    return write_mapped(tmp_path, MANIFEST.removeprefix(HEAD), wheels=ODOMETRY, reads=READS, truth=TRUTH)


@pytest.fixture
def with_options(hall):
    """The manifest with other options in place of all of its own."""

    def change(text):
        hall.write_text(HEAD + text)
        return hall

    return change
