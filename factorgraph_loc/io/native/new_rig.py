"""The first rig of a robot, from what is known of any: its sensors, how many antennas, the size of images."""

import math
from dataclasses import dataclass
from typing import Any, Literal

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import parse_model
from factorgraph_loc.model.rig import Rig
from factors import se2

Drive = Literal["differential", "omnidirectional", "none"]
AROUND, HEIGHT = 0.25, 1.0  # m: distance of antennas from the robot's centre, height of antennas and camera
FIELD_OF_VIEW = math.radians(60.0)


@dataclass(frozen=True)
class RobotOptions:
    """The sensors of a robot. ``landmarks``: standard deviation of a range [m], None without such a sensor; ``antennas``: their
    number; ``camera``: width and height of its images [px]."""

    odometry: Drive = "differential"
    imu: bool = False
    landmarks: float | None = None
    antennas: int = 0
    camera: tuple[int, int] | None = None


def new_rig(name: str, robot: RobotOptions) -> tuple[Rig, list[str]]:
    """A rig with these sensors, and remarks on what is a guess. InputError if a value is out of bounds, or there is no sensor."""
    sections: dict[str, Any] = {}
    sensors: list[str] = []
    remarks: list[str] = []
    if robot.odometry != "none":
        sensors.append("odometry")
        remarks.append("odometry: the noise is that of unknown indoor wheels; `fgloc calibrate` learns it")
    if robot.odometry == "omnidirectional":
        sections["odometry"] = {"noise": {"lateral": Rig().odometry.noise.along.model_dump()}}
    if robot.imu:
        sensors.append("imu")
        sections["imu"] = {}
    if robot.landmarks is not None:
        sensors.append("bearing_range")
        sections["bearing_range"] = {"range_sigma": robot.landmarks}
        remarks.append("bearing_range: the sensor is taken to be at the robot's centre, looking forward")
    if robot.antennas:
        sensors.append("rfid")
        sections["rfid"] = {"antennas": _antennas(robot.antennas)}
        remarks.append(
            "rfid: names and places of the antennas are guesses: measure them; `fgloc calibrate` learns how they read"
        )
    if robot.camera is not None:
        sensors.append("camera")
        sections["camera"] = _camera(*robot.camera)
        remarks.append(
            "camera: lens and mounting are guesses, 60 degrees wide, looking forward; calibrate the lens with OpenCV"
        )
    if not sensors:
        raise InputError("the new rig has no sensors, expected odometry, landmarks, antennas or a camera")
    content = {"name": name, "sensors": sensors, **sections}
    return parse_model(Rig, content, "the new rig"), remarks


def _antennas(count: int) -> dict[str, dict[str, float]]:
    """Antennas 1, 2, ... around the body, counter-clockwise from the front; two look to the left and to the right."""
    first = math.pi / 2.0 if count == 2 else 0.0
    directions = [se2.wrap_scalar(first + 2.0 * math.pi * i / count) for i in range(count)]
    return {
        str(i): {
            "x": round(AROUND * math.cos(yaw), 4),
            "y": round(AROUND * math.sin(yaw), 4),
            "z": HEIGHT,
            "yaw": yaw,
        }
        for i, yaw in enumerate(directions, start=1)
    }


def _camera(width: int, height: int) -> dict[str, float]:
    focal = round(width / 2.0 / math.tan(FIELD_OF_VIEW / 2.0), 1)
    centre = {"cx": (width - 1) / 2.0, "cy": (height - 1) / 2.0}
    return {"width": width, "height": height, "fx": focal, "fy": focal, **centre, "z": HEIGHT}
