"""KITTI odometry: images of a car with ground-truth poses (Geiger, Lenz, Urtasun, "Are we ready for autonomous driving?", CVPR
2012).

The folder contains ``sequences/NN`` with ``times.txt``, ``calib.txt`` and ``image_0`` to ``image_3``, and ``poses/NN.txt``. The
robot frame is that of camera 0, with x forward.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.images import size_of_file
from factorgraph_loc.files.models import FileModel, inside, parse_model, read_text
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.io.readers.left_out import beside, not_read
from factorgraph_loc.io.readers.pose_file import later, read_kitti, read_times
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.tables import make_images


class Options(FileModel):
    """The options of the reader."""

    sequence: Annotated[int, Field(ge=0, le=21)] = 0
    """number of the sequence; those from 11 have no poses"""
    camera: Annotated[int, Field(ge=0, le=3)] = 0
    """number of the camera: 0 and 1 are grey, 2 and 3 colour"""


def read(path: Path | None, options: Options) -> Log:
    """The images with the true poses as ``reference3``; t = 0 at the first image. InputError names the invalid file."""
    if path is None:
        raise InputError("kitti_odometry: the path of the folder with sequences is missing")
    name = f"{options.sequence:02d}"
    folder, poses_file = (inside(path, below, path) for below in (f"sequences/{name}", f"poses/{name}.txt"))
    if not poses_file.is_file():
        raise InputError(f"{poses_file}: does not exist: a log without odometry needs the true poses")
    images, times, calib = (
        inside(folder, below, folder) for below in (f"image_{options.camera}", "times.txt", "calib.txt")
    )
    warnings: list[str] = []
    t_ns = read_times(times)
    rows = np.arange(1, len(t_ns) + 1, dtype=np.int64)
    files = {"file": [f"{i:06d}.png" for i in range(len(t_ns))]}
    t0_ns = int(t_ns[0])
    stream = make_images(TableRows(times, rows, t_ns, {}, files), t0_ns, warnings, images)
    if not len(stream.t):
        raise InputError(f"{images}: holds none of the {len(t_ns)} images of times.txt, 000000.png and on")
    _, poses_ns, poses = read_kitti(poses_file, times)
    camera = _camera(calib, options.camera, size_of_file(stream.file[0]))
    return Log(
        name=f"kitti-{name}",
        rig=Rig(name=f"kitti-{name}-camera{options.camera}", sensors=("camera",), camera=camera),
        world=World(name=f"kitti-{name}"),
        streams={"camera": stream},
        reference3=later(poses, poses_ns, t0_ns),
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata=not_read(beside(folder, (images.name, times.name, calib.name))),
    )


def _camera(path: Path, number: int, size: tuple[int, int]) -> CameraSettings:
    """A rectified camera from its projection matrix, in the frame of camera 0."""
    for row, line in enumerate(read_text(path).splitlines(), start=1):
        key, _, text = line.partition(":")
        if key.strip() != f"P{number}":
            continue
        try:
            values = np.array([float(part) for part in text.split()])
        except ValueError:
            values = np.empty(0)
        if len(values) != 12 or not np.all(np.isfinite(values)):
            raise bad_field(path, f"P{number}", text.strip(), "12 finite numbers", row=row)
        matrix = values.reshape(3, 4)
        focal = np.array((matrix[0, 0], matrix[1, 1]))
        if np.any(focal <= 0.0):
            raise bad_field(path, f"P{number}", text.strip(), "focal lengths above 0", row=row)
        rectified = np.array(((focal[0], 0.0, matrix[0, 2]), (0.0, focal[1], matrix[1, 2]), (0.0, 0.0, 1.0)))
        if np.any(matrix[:, :3] != rectified):
            raise bad_field(path, f"P{number}", text.strip(), "fx 0 cx, 0 fy cy, 0 0 1, each before a fourth", row=row)
        # the fourth column is the matrix times the negative camera position
        right, down, ahead = (-np.linalg.solve(matrix[:, :3], matrix[:, 3])).tolist()
        content = {"width": size[0], "height": size[1], "fx": focal[0], "fy": focal[1]}
        content |= {"cx": matrix[0, 2], "cy": matrix[1, 2], "x": ahead, "y": -right, "z": -down}
        return parse_model(CameraSettings, content, path)
    raise InputError(f"{path}: has no line P{number}: with 12 numbers")
