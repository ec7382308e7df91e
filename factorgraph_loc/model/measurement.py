"""What the sensors of a robot report: frozen values, stamped in seconds from the log's start, in SI units.

Stamps are those of the event, with the known offsets between clocks already applied.
"""

from dataclasses import dataclass
from typing import ClassVar

from factorgraph_loc.sensors.camera.measurement import PixelSightings
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factorgraph_loc.sensors.odometry.measurement import IncrementOdometry, VelocityOdometry, YawRate
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factorgraph_loc.sensors.twist.measurement import Twist
from factorgraph_loc.vision.frame import CameraFrame


@dataclass(frozen=True, slots=True)
class Tick:
    """No measurement: time has passed, and the trajectory is wanted at this stamp."""

    sensor: ClassVar[str] = "tick"
    t: float


Odometry = VelocityOdometry | IncrementOdometry | YawRate | Twist
Exteroceptive = BearingRange | RfidScan | PixelSightings | CameraFrame  # what tells of the world around the robot
Measurement = Odometry | Exteroceptive | Tick
