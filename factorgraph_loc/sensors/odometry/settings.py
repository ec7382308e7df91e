"""Settings of wheel odometry and gyro in a rig."""

from typing import Annotated, ClassVar

from pydantic import Field

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.model.settings import Angle, Noise, Rate, Scale, SensorSettings
from factors.odometry.model import PARAMETERS, Growth


class GrowthSettings(FileModel):
    """Noise of an odometry error (along, lateral or heading). The variance grows with distance, rotation and time."""

    per_distance: Noise = 0.0
    """standard deviation per sqrt(m) travelled"""
    per_rotation: Noise = 0.0
    """standard deviation per sqrt(rad) turned"""
    per_time: Noise = 0.0
    """standard deviation per sqrt(s)"""

    def model(self) -> Growth:
        return Growth(self.per_distance, self.per_rotation, self.per_time)


class OdometryNoise(FileModel):
    """Noise of the odometry. The defaults are for indoor robots with unknown wheels."""

    along: GrowthSettings = GrowthSettings(per_distance=0.05, per_time=0.005)
    """growth of the error along the track [m]"""
    lateral: GrowthSettings = GrowthSettings(per_distance=0.02, per_time=0.005)
    """growth of the error across the track [m]"""
    heading: GrowthSettings = GrowthSettings(per_distance=0.05, per_rotation=0.05, per_time=0.002)
    """growth of the error of the heading [rad]"""


class OdometryUncertainty(FileModel):
    """Standard deviations of the odometry's calibration constants before a run. Constants with values above 0 are
    estimated."""

    scale_distance: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """relative standard deviation of the scale of distances"""
    scale_rotation: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """relative standard deviation of the scale of rotations"""
    heading_rate_bias: Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad/s")] = 0.0
    """standard deviation of the bias of the turn rate"""
    heading_drift: Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad/m")] = 0.0
    """standard deviation of the heading drift"""


class DifferentialDrive(FileModel):
    """Geometry of two driven wheels. Required if the log contains rotations or distances of the wheels instead of the
    motion of the robot."""

    radius: Annotated[float, Field(gt=0.0, le=5.0), InUnit("m")] | None = None
    """radius of the wheels; not needed if the log contains distances of the wheels"""
    track: Annotated[float, Field(gt=0.0, le=20.0), InUnit("m")]
    """distance between the wheels"""

    def corrected(self, scale_distance: float, scale_rotation: float) -> tuple[float | None, float]:
        """Return the wheel radius [m] and the track width [m] that make both scales of the odometry 1. The radius is
        None if it is not set. ``scale_distance``, ``scale_rotation``: the present scales, as in
        :class:`OdometrySettings`."""
        radius = None if self.radius is None else self.radius * scale_distance
        return radius, self.track * scale_distance / scale_rotation


class OdometrySettings(SensorSettings):
    """Constants and noise of wheel odometry. The model is :class:`factors.odometry.model.OdometryModel`."""

    constants: ClassVar[tuple[str, ...]] = PARAMETERS
    scale_distance: Scale = 1.0
    """true divided by reported distance"""
    scale_rotation: Scale = 1.0
    """true divided by reported rotation"""
    speed_bias: Annotated[float, Field(ge=-1.0, le=1.0), InUnit("m/s")] = 0.0
    """speed reported at rest"""
    heading_rate_bias: Rate = 0.0
    """turn rate reported at rest"""
    heading_drift: Annotated[float, Field(ge=-1.0, le=1.0), InUnit("rad/m")] = 0.0
    """unreported change of heading per metre travelled"""
    direction: Angle = 0.0
    """direction of travel, in the robot frame"""
    delay: Annotated[float, Field(ge=0.0, le=2.0), InUnit("s")] = 0.0
    """delay of the wheels' response to commanded velocities"""
    lag: Annotated[float, Field(ge=0.0, le=5.0), InUnit("s")] = 0.0
    """time constant of the wheels' response to commanded velocities"""
    turn_slowdown: Annotated[float, Field(ge=0.0, le=5.0), InUnit("m/rad")] = 0.0
    """loss of commanded speed per turn rate"""
    max_hold: Annotated[float, Field(ge=1e-3, le=60.0), InUnit("s")] = 1.5
    """time for which a velocity is held; after that the motion is unknown"""
    unknown_distance: Annotated[Noise, InUnit("m per sqrt(s)")] = 0.2
    """growth of the error of the position while the motion is unknown"""
    unknown_rotation: Annotated[Noise, InUnit("rad per sqrt(s)")] = 0.2
    """growth of the error of the heading while the motion is unknown"""
    wheels: DifferentialDrive | None = None
    """geometry of two driven wheels, if the log contains their rotations or distances"""
    noise: OdometryNoise = OdometryNoise()
    """growth of the error of the odometry"""
    uncertainty: OdometryUncertainty = OdometryUncertainty()
    """standard deviations of constants; a constant is estimated if its value is above 0"""


class ImuSettings(SensorSettings):
    """Settings of a gyro. If a run uses the sensor "imu", the turn rate of the gyro replaces the rotation of the
    wheels. A rig without this section has the defaults."""

    bias: Rate = 0.0
    """turn rate reported at rest"""
    heading: GrowthSettings = GrowthSettings(per_time=0.005)
    """growth of the error of the heading [rad]"""
