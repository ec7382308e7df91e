"""Microsoft 7-Scenes: colour images of a hand-held camera with ground-truth poses (Shotton et al., "Scene coordinate regression
forests for camera relocalization in RGB-D images", CVPR 2013).

A folder contains ``frame-NUMBER.color.jpg`` (or ``.png``) and ``frame-NUMBER.pose.txt``, 4x4 from camera to world, axes z forward,
x right, y down, from KinectFusion. Frames are sorted by name and get timestamps with a nominal rate, as the recording has none. The
``camera-intrinsics.txt`` in some copies is that of the depth camera and is not read.
"""

import math
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.bounded import IMAGE, opened
from factorgraph_loc.files.images import size_of_file
from factorgraph_loc.files.models import FileModel, InUnit, inside, read_text
from factorgraph_loc.io.readers.left_out import beside, not_read
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory3 import Trajectory3
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.stream import ImageStream
from factors.se2 import Array

IMAGES = ("color.jpg", "color.png")
POSE = "pose.txt"
ORTHONORMAL = 2e-3  # tolerance of rotation matrices, which are in single precision
# the robot frame is the camera frame; the focal length is the nominal one, as 585 is that of the depth camera
RIG = Rig(
    name="kinect",
    sensors=("camera",),
    camera=CameraSettings(width=640, height=480, fx=525, fy=525, cx=320, cy=240, pitch=-math.pi / 2, yaw=math.pi / 2),
)


class Options(FileModel):
    """The options of the reader."""

    rate: Annotated[float, Field(gt=0.0, le=1000.0), InUnit("Hz")] = 15.0
    """nominal frame rate"""


def read(path: Path | None, options: Options) -> Log:
    """The images with the true camera poses as ``reference3``; the robot is the camera. InputError names the invalid file."""
    if path is None:
        raise InputError("sevenscenes: the path of the folder with frame-*.color.jpg is missing")
    images = _frames(path)
    poses = np.array([_pose(inside(path, f"{image.name.split('.')[0]}.{POSE}", path)) for image in images])
    for image in images:
        _check_image(image)
    t = np.arange(len(images)) / options.rate
    return Log(
        name=path.resolve().name,
        rig=RIG,
        world=World(name=path.resolve().name),
        streams={"camera": ImageStream(t, images)},
        reference3=Trajectory3(t, poses[:, :3, 3], poses[:, :3, :3]),
        metadata={"stamps": f"nominal, {options.rate:g} Hz: the recording has none"} | not_read(_others(path)),
    )


def _frames(folder: Path) -> list[Path]:
    images = sorted(file for kind in IMAGES for file in folder.glob(f"frame-*.{kind}"))
    if not images:
        raise InputError(f"{folder}: contains no images frame-*.color.jpg or frame-*.color.png")
    return [inside(folder, image.name, folder) for image in images]


def _others(folder: Path) -> list[str]:
    """What else there is for each frame, such as depth images, and beside the frames."""
    kinds = {name.split(".", 1)[-1] if name.startswith("frame-") else name for name in beside(folder, ())}
    return sorted(kinds - {*IMAGES, POSE})


def _pose(path: Path) -> Array:
    """A pose (4, 4), with its rotation orthonormalized."""
    values = []
    for row, line in enumerate(read_text(path).splitlines(), start=1):
        try:
            numbers = [float(part) for part in line.split()]
        except ValueError as error:
            raise bad_field(path, "row", line.strip(), "4 numbers", row=row) from error
        if numbers and len(numbers) != 4:
            raise bad_field(path, "row", line.strip(), "4 numbers", row=row)
        values += [numbers] if numbers else []
    if len(values) != 4:
        raise InputError(f"{path}: has {len(values)} rows, expected a pose of 4 rows with 4 numbers")
    pose = np.array(values)
    if not np.isfinite(pose).all():
        row, column = np.argwhere(~np.isfinite(pose))[0].tolist()
        raise bad_field(path, f"column {column + 1}", values[row][column], "a finite number", row=row + 1)
    if not np.allclose(pose[3], (0.0, 0.0, 0.0, 1.0), rtol=0.0, atol=1e-6):
        raise bad_field(path, "row", values[3], "0 0 0 1", row=4)
    rotation = pose[:3, :3]
    off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if off > ORTHONORMAL or np.linalg.det(rotation) < 0.0:
        raise InputError(
            f"{path}: its upper left 3x3 is not a rotation (off by {off:.3g}), expected camera axes in the world"
        )
    u, _, vt = np.linalg.svd(rotation)
    pose[:3, :3] = u @ vt
    return pose


def _check_image(path: Path) -> None:
    """InputError for a truncated image, or one of another size than the camera's, without decoding it."""
    camera = RIG.camera
    assert camera is not None
    size = size_of_file(path)
    with opened(path, IMAGE) as file:
        file.seek(-min(path.stat().st_size, 16), 2)
        end = file.read()
    if size != (camera.width, camera.height):
        raise bad_field(path, "size", f"{size[0]} x {size[1]}", f"{camera.width} x {camera.height} px")
    if (b"\xff\xd9" if path.suffix == ".jpg" else b"IEND") not in end:
        raise InputError(f"{path}: ends too early, expected a whole image")
