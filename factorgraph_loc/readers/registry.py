"""The log formats, by name. A module is imported when its format is read."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import FileModel, nearest
from factorgraph_loc.log import Log
from factorgraph_loc.rig import BearingRangeSettings, Rig
from factorgraph_loc.text import quoted

READERS: dict[str, str] = {
    "native": "factorgraph_loc.readers.native",
    "euroc": "factorgraph_loc.readers.euroc",
    "kitti_odometry": "factorgraph_loc.readers.kitti_odometry",
    "mapped": "factorgraph_loc.readers.mapped",
    "mrclam": "factorgraph_loc.readers.mrclam",
    "plaza": "factorgraph_loc.readers.plaza",
    "rf_robot": "factorgraph_loc.readers.rf_robot",
    "rosbag": "factorgraph_loc.readers.rosbag",
    "sevenscenes": "factorgraph_loc.readers.sevenscenes",
    "starry_night": "factorgraph_loc.readers.starry_night",
    "tum_rgbd": "factorgraph_loc.readers.tum_rgbd",
    "utias_woods": "factorgraph_loc.readers.utias_woods",
}

# what a reader gives where the format says nothing of the robot
DEFAULT_RIG = Rig(
    name="default",
    bearing_range=BearingRangeSettings(range_sigma=0.2, range_sigma_relative=0.1, bearing_sigma=0.05),
)


@dataclass(frozen=True)
class Reader:
    """A format: the model of its options, and ``read(path, options)``, which makes the log."""

    options: type[FileModel]
    read: Callable[[Path | None, Any], Log]


def reader(name: str) -> Reader:
    """The reader of a format; InputError with the nearest name if there is none."""
    if name not in READERS:
        raise InputError(f"there is no reader {quoted(name)}{nearest(name, list(READERS))}")
    module = importlib.import_module(READERS[name])
    return Reader(module.Options, module.read)
