"""The lens and the mounting of a camera from a camera chain of Kalibr (``camchain.yaml`` or ``camchain-imucam.yaml``)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.models import FileModel, nearest, parse_model
from factorgraph_loc.files.yaml import read_yaml
from factorgraph_loc.text import listed, quoted
from factors.camera.model import angles_of_camera
from factors.se2 import Array

SUFFIXES = (".yaml", ".yml")
MODEL = "pinhole"
LENSES = {"radtan": "plumb_bob", "equidistant": "equidistant", "none": "plumb_bob"}
ORTHONORMAL = 1e-3  # tolerance of rotations
Number = Annotated[float, Field(ge=-1e6, le=1e6)]
Row = tuple[Number, Number, Number, Number]
Matrix = tuple[Row, Row, Row, Row]
WITHOUT = "camera: {name} of {file} has no mounting on the robot: set x, y, z, roll, pitch and yaw in [camera]"
ON_IMU = (
    "camera: the mounting is that on the IMU of {file}: it holds if the IMU is at the robot's centre and its axes point forward, "
    "left and up; otherwise set x, y, z, roll, pitch and yaw"
)


class ChainCamera(FileModel):
    """A camera of a Kalibr camera chain. ``T_cam_imu``: transform (4, 4) from the IMU to the camera. ``T_imu_cam``: its
    inverse. ``T_cn_cnm1``: transform from the previous camera of the chain to this one."""

    camera_model: str
    distortion_model: str = "none"
    intrinsics: tuple[Number, ...]
    distortion_coeffs: tuple[Number, ...] = ()
    resolution: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]
    T_cam_imu: Matrix | None = None
    T_imu_cam: Matrix | None = None
    T_cn_cnm1: Matrix | None = None
    timeshift_cam_imu: Number | None = None
    rostopic: str = ""


def is_chain(text: str) -> bool:
    """True if a text names a YAML file, such as ``FILE.yaml`` or ``FILE.yaml:cam1``."""
    return text.endswith(SUFFIXES) or text.rpartition(":")[0].endswith(SUFFIXES)


def read_camera(text: str) -> tuple[dict[str, Any], list[str]]:
    """Return a camera of a Kalibr camera chain as the section ``[camera]`` of a rig file, and remarks for the user.

    ``text``: the file of the chain; ``FILE:cam1`` selects one of several cameras. Raises InputError if the file is
    invalid or the lens model is not supported.
    """
    file, _, name = (text, "", "") if text.endswith(SUFFIXES) else text.rpartition(":")
    path = Path(file)
    stated = {
        key: value for key, value in read_yaml(path).items() if isinstance(value, Mapping) and "intrinsics" in value
    }
    if not stated:
        raise InputError(f"{path}: has no camera with intrinsics, expected a camera chain of Kalibr")
    if not name and len(stated) > 1:
        raise InputError(
            f"{path}: has the cameras {listed(stated)}: name one of them, such as {path}:{next(iter(stated))}"
        )
    name = name or next(iter(stated))
    if name not in stated:
        raise InputError(f"{path}: has no camera {quoted(name)}{nearest(name, list(stated))}")
    chain = {key: _camera(path, key, value) for key, value in stated.items()}
    camera = chain[name]
    section = _lens(path, name, camera)
    mounting = _pose_in_imu(path, chain, name)
    remarks = [(WITHOUT if mounting is None else ON_IMU).format(name=name, file=path.name)]
    if mounting is not None:
        roll, pitch, yaw = angles_of_camera(mounting[:3, :3])
        x, y, z = mounting[:3, 3].tolist()
        section |= {"x": x, "y": y, "z": z, "roll": roll, "pitch": pitch, "yaw": yaw}
    if shift := camera.timeshift_cam_imu:
        remarks.append(f"camera: set time_offset = {shift:g} if the odometry has the clock of Kalibr's IMU")
    if camera.rostopic:
        remarks.append(f"camera: the calibrated images were on the topic {camera.rostopic}")
    return section, remarks


def _camera(path: Path, name: str, content: Mapping[str, Any]) -> ChainCamera:
    """Return a camera from its ``content``, the keys and values in the file ``path``. ``name``: its name, for errors.

    Keys that are not needed are ignored."""
    known = {key: value for key, value in content.items() if key in ChainCamera.model_fields and value is not None}
    return parse_model(ChainCamera, known, f"{path}: {name}")


def _lens(path: Path, name: str, camera: ChainCamera) -> dict[str, Any]:
    """Return the lens of ``camera`` as settings of a rig. Raises InputError if the lens model is not supported."""
    if camera.camera_model != MODEL:
        raise bad_field(path, f"{name}.camera_model", camera.camera_model, MODEL)
    if camera.distortion_model not in LENSES:
        raise bad_field(path, f"{name}.distortion_model", camera.distortion_model, f"one of {', '.join(LENSES)}")
    count = 0 if camera.distortion_model == "none" else 4
    for key, values, expected in (
        ("intrinsics", camera.intrinsics, 4),
        ("distortion_coeffs", camera.distortion_coeffs[: None if count else 0], count),
    ):
        if len(values) != expected:
            raise bad_field(path, f"{name}.{key}", list(values), f"{expected} numbers")
    width, height = camera.resolution
    lens = dict(zip(("fx", "fy", "cx", "cy"), camera.intrinsics, strict=True))
    distortion = camera.distortion_coeffs if count else (0.0, 0.0, 0.0, 0.0)
    model = LENSES[camera.distortion_model]
    return {"width": width, "height": height, **lens, "distortion_model": model, "distortion": distortion}


def _pose_in_imu(path: Path, chain: Mapping[str, ChainCamera], name: str) -> Array | None:
    """Return the pose (4, 4) of the camera ``name`` in the frame of the IMU. Returns None if it is unknown.

    The transform to the IMU may be that of a previous camera of the chain."""
    names = list(chain)
    from_later = np.eye(4)
    for known in reversed(names[: names.index(name) + 1]):
        camera = chain[known]
        if camera.T_imu_cam is not None:
            return _transform(path, f"{known}.T_imu_cam", camera.T_imu_cam) @ from_later
        if camera.T_cam_imu is not None:
            return np.asarray(np.linalg.inv(_transform(path, f"{known}.T_cam_imu", camera.T_cam_imu)) @ from_later)
        if camera.T_cn_cnm1 is None:
            return None
        from_later = np.linalg.inv(_transform(path, f"{known}.T_cn_cnm1", camera.T_cn_cnm1)) @ from_later
    return None


def _transform(path: Path, key: str, rows: Matrix) -> Array:
    """Return the transform (4, 4) in ``rows``, the value of ``key``. Raises InputError if it is not rigid."""
    matrix = np.array(rows)
    off = np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max()
    if off > ORTHONORMAL or np.linalg.det(matrix[:3, :3]) < 0.0 or np.any(matrix[3] != (0.0, 0.0, 0.0, 1.0)):
        raise bad_field(path, key, matrix.tolist(), "a rotation and a translation")
    return matrix
