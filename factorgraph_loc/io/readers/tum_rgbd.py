"""TUM RGB-D: colour images of a hand-held camera, listed in ``rgb.txt``, with ground-truth poses in ``groundtruth.txt`` (Sturm et
al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012). A depth image, listed in ``depth.txt``, belongs to the
colour image nearest in time. The accelerometer is not read."""

import math
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, inside
from factorgraph_loc.io.readers.left_out import beside, not_read
from factorgraph_loc.io.readers.pose_file import TUM, later, read_image_list, read_poses
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraSettings, DepthSettings
from factorgraph_loc.sensors.camera.stream import ImageStream
from factorgraph_loc.sensors.camera.tables import make_images

# the robot frame is the camera frame; the lens is the nominal one of the benchmark
RIG = Rig(
    name="kinect-tum",
    sensors=("camera",),
    camera=CameraSettings(
        width=640,
        height=480,
        fx=525,
        fy=525,
        cx=319.5,
        cy=239.5,
        pitch=-math.pi / 2,
        yaw=math.pi / 2,
        depth=DepthSettings(unit=1.0 / 5000.0),
    ),
)


class Options(FileModel):
    """The format has no options."""


def read(path: Path | None, options: Options) -> Log:  # noqa: ARG001 - every reader takes options
    """The images with the true camera poses as ``reference3``; t = 0 at the first image. InputError names the invalid file."""
    if path is None:
        raise InputError("tum_rgbd: the path of the folder with rgb.txt is missing")
    warnings: list[str] = []
    table = read_image_list(inside(path, "rgb.txt", path), unit="s", separator=" ")
    t0_ns = int(table.t_ns.min())
    t_ns, poses = read_poses(inside(path, "groundtruth.txt", path), TUM, unit="s", separator=" ", warnings=warnings)
    name = path.resolve().name
    images = _with_depth(make_images(table, t0_ns, warnings, path), path, t0_ns, warnings)
    deep = any(file is not None for file in images.depth)
    return Log(
        name=name,
        rig=RIG if deep else RIG.model_copy(update={"camera": RIG.camera.model_copy(update={"depth": None})}),
        world=World(name=name),
        streams={"camera": images},
        reference3=later(poses, t_ns, t0_ns),
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata=not_read(beside(path, ("rgb", "rgb.txt", "depth", "depth.txt", "groundtruth.txt"))),
    )


def _with_depth(images: ImageStream, path: Path, t0_ns: int, warnings: list[str]) -> ImageStream:
    """The images with the depth image of each, nearest in time."""
    if not (path / "depth.txt").is_file():
        return images
    depths = make_images(
        read_image_list(inside(path, "depth.txt", path), unit="s", separator=" "), t0_ns, warnings, path
    )
    return images.with_depths(depths)
