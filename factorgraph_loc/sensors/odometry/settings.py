"""Rig settings of wheel odometry and gyro."""

from typing import Annotated, ClassVar

from pydantic import Field

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.model.settings import SensorSettings
from factorgraph_loc.model.units import Angle, Noise, Rate, Scale
from factors.odometry.model import PARAMETERS, Growth


class GrowthSettings(FileModel):
    """Standard deviation per sqrt(m) travelled, per sqrt(rad) turned, per sqrt(s) elapsed."""

    per_distance: Noise = 0.0
    per_rotation: Noise = 0.0
    per_time: Noise = 0.0

    def model(self) -> Growth:
        return Growth(self.per_distance, self.per_rotation, self.per_time)


class OdometryNoise(FileModel):
    """Growth of the error: along the track [m], across it [m], in heading [rad]. The defaults are for unknown indoor wheels."""

    along: GrowthSettings = GrowthSettings(per_distance=0.05, per_time=0.005)
    lateral: GrowthSettings = GrowthSettings(per_distance=0.02, per_time=0.005)
    heading: GrowthSettings = GrowthSettings(per_distance=0.05, per_rotation=0.05, per_time=0.002)


class OdometryUncertainty(FileModel):
    """Standard deviations of constants that differ between robots or runs; those above 0 are estimated.

    Those of the scales are relative; that of the heading-rate bias is in rad/s, that of the drift in rad/m.
    """

    scale_distance: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    scale_rotation: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    heading_rate_bias: Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad/s")] = 0.0
    heading_drift: Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad/m")] = 0.0


class OdometrySettings(SensorSettings):
    """Wheel odometry. See :class:`factors.odometry.model.OdometryModel` for the model."""

    constants: ClassVar[tuple[str, ...]] = PARAMETERS
    scale_distance: Scale = 1.0
    scale_rotation: Scale = 1.0
    speed_bias: Annotated[float, Field(ge=-1.0, le=1.0), InUnit("m/s")] = 0.0
    heading_rate_bias: Rate = 0.0
    heading_drift: Annotated[float, Field(ge=-1.0, le=1.0), InUnit("rad/m")] = 0.0
    direction: Angle = 0.0
    delay: Annotated[float, Field(ge=0.0, le=2.0), InUnit("s")] = 0.0
    lag: Annotated[float, Field(ge=0.0, le=5.0), InUnit("s")] = 0.0
    turn_slowdown: Annotated[float, Field(ge=0.0, le=5.0), InUnit("m/rad")] = 0.0
    max_hold: Annotated[float, Field(ge=1e-3, le=60.0), InUnit("s")] = 1.5
    unknown_distance: Noise = 0.2
    unknown_rotation: Noise = 0.2
    noise: OdometryNoise = OdometryNoise()
    uncertainty: OdometryUncertainty = OdometryUncertainty()


class ImuSettings(SensorSettings):
    """The gyro. Its yaw rate replaces the rotation of the wheels if an estimator uses the sensor ``imu``; a rig without these
    settings has the default ones."""

    bias: Rate = 0.0
    heading: GrowthSettings = GrowthSettings(per_time=0.005)
