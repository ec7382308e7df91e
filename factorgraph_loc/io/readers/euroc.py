"""The EuRoC (ASL) format: images and an inertial unit of a flying robot with ground-truth poses (Burri et al., "The EuRoC micro
aerial vehicle datasets", International Journal of Robotics Research 2016).

``mav0/cam0/data.csv`` lists the images in ``mav0/cam0/data``; ``sensor.yaml`` next to it has the camera's calibration and mounting
on the body, whose poses are in ``mav0/state_groundtruth_estimate0/data.csv``. The inertial unit is in ``mav0/imu0``: ``data.csv``
has turn rates and specific forces, ``sensor.yaml`` its noise and mounting; without that it is not read. The densities in
``sensor.yaml`` are those of a unit at rest: in flight errors are so much larger that the rig has :data:`IN_FLIGHT` times these.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.column_mapping import ColumnMapping, read_mapped
from factorgraph_loc.files.models import FileModel, inside, parse_model
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.files.yaml import read_yaml
from factorgraph_loc.io.readers.left_out import beside, columns_after, not_read
from factorgraph_loc.io.readers.pose_file import EUROC, ORTHONORMAL, later, read_image_list, read_poses
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.tables import make_images
from factorgraph_loc.sensors.inertial.measurement import INERTIAL
from factorgraph_loc.sensors.inertial.settings import InertialSettings
from factorgraph_loc.sensors.tables import stream_of
from factorgraph_loc.text import listed
from factors.camera.model import FORWARD, angles_of_camera
from factors.se2 import Array

UNIT = "imu0"
IN_FLIGHT = 10.0  # velocities differ from those of V1_02, V1_03, MH_04, MH_05 by 9 to 13 times as much, after 0.2 s
TRUTHS = ("state_groundtruth_estimate0", "state_groundtruth0")
UNDISTORTED = ("none", "pinhole", "")


class Options(FileModel):
    """The options of the reader."""

    camera: Annotated[int, Field(ge=0, le=9)] = 0
    """number of the camera"""


class _Placed(FileModel):
    """Where a sensor is, in ``sensor.yaml``."""

    T_BS: Annotated[tuple[float, ...], Field(min_length=16, max_length=16)]


class _Camera(_Placed):
    """The used part of a camera's ``sensor.yaml``."""

    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, float, float, float]
    resolution: tuple[int, int]


class _Unit(_Placed):
    """The used part of an inertial unit's ``sensor.yaml``."""

    gyroscope_noise_density: float
    gyroscope_random_walk: float
    accelerometer_noise_density: float
    accelerometer_random_walk: float


def read(path: Path | None, options: Options) -> Log:
    """The images, and the rows of the inertial unit, with the true body poses as ``reference3``; t = 0 at the first image.
    InputError names the invalid file."""
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
    settings: dict[str, Any] = {"camera": _camera(inside(camera, "sensor.yaml", camera))}
    streams: dict[str, Stream] = {"camera": make_images(table, t0_ns, warnings, inside(camera, "data", camera))}
    used, unit = [camera.name, truth.parent.name], inside(folder, UNIT, folder)
    if (unit / "sensor.yaml").is_file():
        used.append(UNIT)
        settings["inertial"] = _unit(inside(unit, "sensor.yaml", unit))
        streams["inertial"] = stream_of(INERTIAL, _rows(inside(unit, "data.csv", unit)), t0_ns, warnings)
    return Log(
        name=name,
        rig=Rig(name=f"{name}-cam{options.camera}", sensors=tuple(streams), **settings),
        world=World(name=name),
        streams=streams,
        reference3=later(poses, t_ns, t0_ns),
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata=not_read(
            [*beside(folder, used), *columns_after(truth, len(EUROC))],
        ),
    )


def _camera(path: Path) -> CameraSettings:
    found = read_yaml(path)
    model = str(found.get("distortion_model", ""))
    if model not in {"radial-tangential", "radtan", *UNDISTORTED}:
        raise bad_field(path, "distortion_model", model, "radial-tangential")
    told = {
        "intrinsics": found.get("intrinsics"),
        "distortion": found.get("distortion_coefficients", (0.0,) * 4),
        "resolution": found.get("resolution"),
        "T_BS": _pose(found),
    }
    sensor = parse_model(_Camera, {key: value for key, value in told.items() if value is not None}, path)
    fx, fy, cx, cy = sensor.intrinsics
    content = {
        "width": sensor.resolution[0],
        "height": sensor.resolution[1],
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "distortion": sensor.distortion,
    }
    return parse_model(CameraSettings, content | _mounting(sensor, path, np.eye(3)), path)


def _unit(path: Path) -> InertialSettings:
    found = read_yaml(path)
    told = {name: found[name] for name in _Unit.model_fields if name in found} | {"T_BS": _pose(found)}
    sensor = parse_model(_Unit, {key: value for key, value in told.items() if value is not None}, path)
    content = {
        "force_noise": IN_FLIGHT * sensor.accelerometer_noise_density,
        "turn_noise": IN_FLIGHT * sensor.gyroscope_noise_density,
        "force_walk": sensor.accelerometer_random_walk,
        "turn_walk": sensor.gyroscope_random_walk,
    }
    return parse_model(InertialSettings, content | _mounting(sensor, path, FORWARD), path)


def _rows(path: Path) -> TableRows:
    """The rows of the inertial unit, as the table ``inertial`` of the native format."""
    names = ("t", "wx", "wy", "wz", "ax", "ay", "az")
    columns = {name: str(i) for i, name in enumerate(names, start=1)}
    told = ColumnMapping(file=path.name, columns=columns, units={"t": "ns"}, separator=",", header=False)
    mapped = read_mapped(path, told, (names,))
    numbers = {name: mapped.numbers(name, INERTIAL[name]) for name in names[1:]}
    return TableRows(path, mapped.rows, mapped.stamps("t"), numbers, {})


def _pose(found: Mapping[str, Any]) -> Any:
    """The pose on the body in the content of ``sensor.yaml``."""
    placed = found.get("T_BS")
    return placed.get("data") if isinstance(placed, dict) else placed


def _mounting(sensor: _Placed, path: Path, axes: Array) -> dict[str, float]:
    """Position and angles of a sensor whose axes, where it is not turned, are ``axes`` (3, 3) of a camera's that looks ahead."""
    pose: Array = np.array(sensor.T_BS).reshape(4, 4)
    rotation = pose[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > ORTHONORMAL or np.linalg.det(rotation) < 0.0:
        raise bad_field(path, "T_BS", rotation.tolist(), "a pose of the sensor on the body")
    angles = angles_of_camera(rotation @ axes)
    return dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), (*pose[:3, 3].tolist(), *angles), strict=True))
