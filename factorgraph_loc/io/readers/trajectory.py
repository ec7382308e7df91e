"""A file of poses alone as a log: they are its reference, or its odometry.

TUM, KITTI and EuRoC files are told apart by their first row, see :mod:`factorgraph_loc.io.readers.pose_file`.
"""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import inside, read_text
from factorgraph_loc.io import motions
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG
from factorgraph_loc.io.readers.pose_file import EUROC, read_pose_file, stamps_of
from factorgraph_loc.model.log import NOT_READ, Log
from factorgraph_loc.model.planar import Turned
from factorgraph_loc.model.pose_path import PosePath
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.odometry.measurement import IncrementStream
from factorgraph_loc.text import listed
from factors.se2 import Integers

RATE = 10.0  # Hz, of KITTI's camera
TIMES = ".times.txt"  # beside a file of KITTI's poses


class Options(Turned):
    """``axes`` are by default ``body``; for KITTI's poses, which are those of a camera, ``optical``, unless NAME.times.txt is
    beside them."""

    use: Literal["reference", "odometry"] = "reference"
    """what the poses are: the reference, or the odometry, seen from above"""
    times: str | None = None
    """file of the times of KITTI's poses, by default NAME.times.txt beside them; without one they come ten a second"""


def read(path: Path | None, options: Options) -> Log:
    """The log of a file of poses, seen from above; t = 0 at the first one. InputError names file and row."""
    if path is None or not path.is_file():
        raise InputError(f"{path}: is not a file, expected one with poses in TUM, KITTI or EuRoC format")
    found = read_pose_file(path)
    warnings = list(found.warnings)
    t_ns = _stamps(path, found, options.times, warnings)
    t0_ns = int(t_ns[0])
    if found.t_ns is None and options.axes is None and not _beside(path).is_file():
        options = options.model_copy(update={"axes": "optical"})
    t = checks.seconds(t_ns, t0_ns)
    names = _columns_after(path, len(EUROC))
    left_out = {NOT_READ: listed(names)} if names else {}
    bare = Log(path.stem, Rig(name=path.stem, sensors=()), World(name=path.stem), {}, t0_ns=t0_ns, metadata=left_out)
    poses = found.on_floor(warnings, options)
    if options.use == "reference":
        return replace(bare, reference=Trajectory(t, poses), warnings=tuple(warnings))
    moves = motions.after_rest(motions.between_poses(path, t_ns, poses, warnings))
    odometry = IncrementStream(t, *moves.T)
    return replace(bare, rig=DEFAULT_RIG, streams={"odometry": odometry}, warnings=tuple(warnings))


def _columns_after(path: Path, count: int) -> list[str]:
    """The columns of a table with commas after the first ``count``: their names in the comment above the rows, or numbers."""
    names: list[str] = []
    for line in read_text(path).splitlines():
        if line.lstrip().startswith("#"):
            names = [name.strip(" #") for name in line.split(",")]
        elif line.strip():
            width = line.count(",") + 1
            known = names if len(names) == width else [f"column {i}" for i in range(1, width + 1)]
            return [f"{path.name}: {name}" for name in known[count:]]
    return []


def _stamps(path: Path, found: PosePath, times: str | None, warnings: list[str]) -> Integers:
    if found.t_ns is not None:
        if times is not None:
            raise InputError(f"{path}: has stamps of its own, expected no times")
        return found.t_ns
    beside = _beside(path)
    if times is not None or beside.is_file():
        return stamps_of(path, len(found), beside if times is None else inside(path.parent, times, path))
    warnings.append(
        f"{path}: has no stamps, and is taken for {RATE:g} poses a second: the option times names their file"
    )
    return np.arange(len(found), dtype=np.int64) * round(1e9 / RATE)


def _beside(path: Path) -> Path:
    """The file of stamps that `fgloc export` writes beside poses in KITTI's format."""
    return path.with_name(path.stem + TIMES)
