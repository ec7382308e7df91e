"""The EuRoC (ASL) format: images of a camera on a flying robot with ground-truth poses (Burri et al., "The EuRoC micro aerial
vehicle datasets", International Journal of Robotics Research 2016).

``mav0/cam0/data.csv`` lists the images in ``mav0/cam0/data``; ``sensor.yaml`` next to it has the camera's calibration and mounting
on the body, whose poses are in ``mav0/state_groundtruth_estimate0/data.csv``. The gyro is not read, because its rates are not those
of a robot on a floor.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.models import FileModel, inside, parse_model
from factorgraph_loc.files.yaml import read_yaml
from factorgraph_loc.io.readers.left_out import beside, columns_after, not_read
from factorgraph_loc.io.readers.pose_file import EUROC, ORTHONORMAL, later, read_image_list, read_poses
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.tables import make_images
from factorgraph_loc.text import listed
from factors.camera.model import angles_of_camera
from factors.se2 import Array

TRUTHS = ("state_groundtruth_estimate0", "state_groundtruth0")
UNDISTORTED = ("none", "pinhole", "")


class Options(FileModel):
    """The options of the reader."""

    camera: Annotated[int, Field(ge=0, le=9)] = 0
    """number of the camera"""


class _Sensor(FileModel):
    """The used part of ``sensor.yaml``."""

    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, float, float, float]
    resolution: tuple[int, int]
    T_BS: Annotated[tuple[float, ...], Field(min_length=16, max_length=16)]


def read(path: Path | None, options: Options) -> Log:
    """The images with the true body poses as ``reference3``; t = 0 at the first image. InputError names the invalid file."""
    if path is None:
        raise InputError("euroc: the path of the folder with mav0 is missing")
    folder = inside(path, "mav0", path) if (path / "mav0").is_dir() else path
    camera = inside(folder, f"cam{options.camera}", folder)
    if not camera.is_dir():
        there = sorted(f.name for f in folder.glob("cam?"))
        raise InputError(f"{camera}: does not exist, there are {listed(there) or 'no cameras'}")
    truth = next((inside(folder, f"{name}/data.csv", folder) for name in TRUTHS if (folder / name).is_dir()), None)
    if truth is None:
        raise InputError(f"{folder}: has no {TRUTHS[0]}, which a log without odometry needs")
    warnings: list[str] = []
    table = read_image_list(inside(camera, "data.csv", camera), unit="ns", separator=",")
    t0_ns = int(table.t_ns.min())
    t_ns, poses = read_poses(truth, EUROC, unit="ns", separator=",", warnings=warnings)
    name = path.resolve().name
    return Log(
        name=name,
        rig=Rig(
            name=f"{name}-cam{options.camera}",
            sensors=("camera",),
            camera=_camera(inside(camera, "sensor.yaml", camera)),
        ),
        world=World(name=name),
        streams={"camera": make_images(table, t0_ns, warnings, inside(camera, "data", camera))},
        reference3=later(poses, t_ns, t0_ns),
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata=not_read(
            [*beside(folder, (camera.name, truth.parent.name)), *columns_after(truth, len(EUROC))],
        ),
    )


def _camera(path: Path) -> CameraSettings:
    found = read_yaml(path)
    model = str(found.get("distortion_model", ""))
    placed = found.get("T_BS")
    if model not in {"radial-tangential", "radtan", *UNDISTORTED}:
        raise bad_field(path, "distortion_model", model, "radial-tangential")
    told = {
        "intrinsics": found.get("intrinsics"),
        "distortion": found.get("distortion_coefficients", (0.0,) * 4),
        "resolution": found.get("resolution"),
        "T_BS": placed.get("data") if isinstance(placed, dict) else placed,
    }
    sensor = parse_model(_Sensor, {key: value for key, value in told.items() if value is not None}, path)
    pose: Array = np.array(sensor.T_BS).reshape(4, 4)
    rotation = pose[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > ORTHONORMAL or np.linalg.det(rotation) < 0.0:
        raise bad_field(path, "T_BS", rotation.tolist(), "a pose of the camera on the body")
    roll, pitch, yaw = angles_of_camera(rotation)
    fx, fy, cx, cy = sensor.intrinsics
    x, y, z = pose[:3, 3].tolist()
    content = {
        "width": sensor.resolution[0],
        "height": sensor.resolution[1],
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "distortion": sensor.distortion,
    }
    mounting = {"x": x, "y": y, "z": z, "roll": roll, "pitch": pitch, "yaw": yaw}
    return parse_model(CameraSettings, content | mounting, path)
