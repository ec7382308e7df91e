"""Unions of the measurement types of this project's sensors."""

from factorgraph_loc.sensors.camera.measurement import PixelSightings
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factorgraph_loc.sensors.loops.measurement import Loops
from factorgraph_loc.sensors.odometry.measurement import IncrementOdometry, VelocityOdometry, YawRate
from factorgraph_loc.sensors.rfid.stream import RfidScan
from factorgraph_loc.vision.frame import CameraFrame

Odometry = VelocityOdometry | IncrementOdometry | YawRate
Exteroceptive = BearingRange | RfidScan | PixelSightings | CameraFrame | Loops  # of the robot's surroundings
