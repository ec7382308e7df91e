"""Small hand-made logs, one folder per format."""

from collections.abc import Callable
from pathlib import Path

import pytest
from bag_maker import BagMaker
from mapped_hall import hall, with_options  # noqa: F401 - fixtures
from refusal import refusal
from rosbag_drive import maker, read_drive, refuse_drive  # noqa: F401 - fixtures
from rosbag_reads import bag, mcap, read, refuse  # noqa: F401 - fixtures

from factorgraph_loc import Log, load

RUN = """\
name = "hall"
[rig]
name = "cart"
bearing_range = { range_sigma = 0.1, bearing_sigma = 0.02 }
[world.landmarks]
A = { x = 1.0, y = 2.0 }
B = { x = 3.0, y = 0.0 }
"""
ODOMETRY = "t_ns,v,w\n1000000000,0.5,0.1\n1500000000,0.5,0.0\n2000000000,0.0,0.0\n"
SIGHTINGS = "t_ns,landmark,range,bearing\n1200000000,A,2.5,0.3\n1200000000,B,,-0.2\n1600000000,A,2.25,\n"
REFERENCE = "# t x y z qx qy qz qw\n1.0 0 0 0 0 0 0 1\n1.5 0.25 0 0 0 0 0 1\n"

DAT = {
    "Barcodes.dat": "# comment\n  1 \t 5\n  2 \t 14\n  6 \t 63\n  7 \t 81\n",
    "Landmark_Groundtruth.dat": "# comment\n  6 \t 0.5 \t -4.2 \t 0.0001 \t 0.0002\n 7 1.5 2.0 0.0003 0.0001\n",
    "Robot1_Odometry.dat": "# comment\n1248444187.156 \t 0.086 \t -0.398\n1248444187.186 0.1 0.0\n1248444187.197 0.1 0.2\n",
    "Robot1_Measurement.dat": (
        "# comment\n1248444187.160 \t 63 \t 3.787 \t -0.257\n1248444187.160 81 2.0 0.1\n"
        "1248444187.190 14 1.0 0.0\n1248444187.195 99 1.0 0.0\n"
    ),
    "Robot1_Groundtruth.dat": "# comment\n1248444187.100 1.0 -3.0 2.25\n1248444187.200 1.1 -3.0 2.25\n",
}


@pytest.fixture
def native(tmp_path: Path) -> Path:
    """A log in the native format: three rows of odometry, three sightings, two poses."""
    folder = tmp_path / "hall"
    folder.mkdir()
    (folder / "run.toml").write_text(RUN)
    (folder / "odometry.csv").write_text(ODOMETRY)
    (folder / "bearing_range.csv").write_text(SIGHTINGS)
    (folder / "reference.tum").write_text(REFERENCE)
    return folder


@pytest.fixture
def mrclam(tmp_path: Path) -> Path:
    """A MRCLAM folder: three rows of odometry; two landmarks, a robot and an unknown barcode seen."""
    folder = tmp_path / "set"
    folder.mkdir()
    for name, text in DAT.items():
        (folder / name).write_text(text)
    return folder


@pytest.fixture
def one() -> Callable[..., Log]:
    """``load`` of what must be one log."""

    def call(path: Path | str, **kwargs: object) -> Log:
        (log,) = load(str(path), **kwargs)
        return log

    return call


@pytest.fixture
def refused() -> Callable[..., str]:
    """The message, of one line, with which ``load`` refuses; it must hold all ``fragments``."""

    def call(path: Path | str, *fragments: str, **kwargs: object) -> str:
        return refusal(lambda: load(str(path), **kwargs), *fragments)

    return call


@pytest.fixture
def bag_maker() -> type[BagMaker]:
    return BagMaker
