"""The part of the rig that a bag contains: the camera, and the mounting of camera and antennas."""

import math
from collections.abc import Iterable, Mapping

import numpy as np

from factorgraph_loc.files.models import parse_model
from factorgraph_loc.io.bags.camera import Info
from factorgraph_loc.io.bags.frames import StaticFrames
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings
from factorgraph_loc.text import plain
from factors.camera.model import angles_of_camera
from factors.se2 import Array


def camera_of(info: Info, frames: StaticFrames, base: str, notes: list[str]) -> CameraSettings:
    """The camera of a ``CameraInfo``; it looks forward from the robot's origin if tf_static has no mounting."""
    pose = frames.pose(info.frame, base)
    if pose is None:
        notes.append(f"tf_static has no mounting of {info.frame} on {base}")
        return info.settings({}, notes)
    notes.append(f"tf_static has the mounting of {info.frame} on {base}")
    roll, pitch, yaw = angles_of_camera(pose[:3, :3])
    x, y, z = pose[:3, 3].tolist()
    return info.settings({"x": x, "y": y, "z": z, "roll": roll, "pitch": pitch, "yaw": yaw}, notes)


def antennas_of(
    names: Iterable[str], given: Mapping[str, str], frames: StaticFrames, base: str, notes: list[str]
) -> RfidSettings:
    """Antennas with frames ``given``, or frames of their names; the frame's x axis is the boresight. Others are at the origin."""
    poses = {name: frames.pose(given.get(name, name), base) for name in sorted(names)}
    for verb, told in (("has the", True), ("has no", False)):
        if which := [name for name, pose in poses.items() if (pose is not None) == told]:
            notes.append(f"tf_static {verb} mounting of antennas {', '.join(which)} on {base}")
    return RfidSettings(
        antennas={name: AntennaSettings() if p is None else _antenna(name, p) for name, p in poses.items()}
    )


def rig_of(sensors: Iterable[str], camera: CameraSettings | None, rfid: RfidSettings | None) -> Rig:
    """A rig with the known settings and the default noise."""
    return DEFAULT_RIG.model_copy(update={"sensors": tuple(sensors), "camera": camera, "rfid": rfid})


def _antenna(name: str, pose: Array) -> AntennaSettings:
    x, y, z = pose[:3, 3].tolist()
    ahead = pose[:3, 0]
    pitch = math.asin(float(np.clip(ahead[2], -1.0, 1.0)))
    place = {"x": x, "y": y, "z": z, "yaw": math.atan2(ahead[1], ahead[0]), "pitch": pitch}
    return parse_model(AntennaSettings, place, f"tf_static of antenna {plain(name)}")
