"""The log formats, by name. A module is imported when its format is read."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, nearest
from factorgraph_loc.model.log import Log
from factorgraph_loc.text import quoted

READERS: dict[str, str] = {
    "native": "factorgraph_loc.io.native.native",
    "euroc": "factorgraph_loc.io.readers.euroc",
    "kitti_odometry": "factorgraph_loc.io.readers.kitti_odometry",
    "mapped": "factorgraph_loc.io.readers.mapped",
    "mrclam": "factorgraph_loc.io.readers.mrclam",
    "plaza": "factorgraph_loc.io.readers.plaza",
    "rf_robot": "factorgraph_loc.io.readers.rf_robot",
    "rosbag": "factorgraph_loc.io.bags.rosbag",
    "sevenscenes": "factorgraph_loc.io.readers.sevenscenes",
    "starry_night": "factorgraph_loc.io.readers.starry_night",
    "tum_rgbd": "factorgraph_loc.io.readers.tum_rgbd",
    "utias_woods": "factorgraph_loc.io.readers.utias_woods",
}


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
