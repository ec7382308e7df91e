"""What the robot carries, and what we believe about it, read from and written to ``NAME.rig.toml``.

Every number has its unit in the description; the bounds are there to catch wrong units (degrees for radians, mm for m).
"""

from __future__ import annotations

import math

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.model.variable import Estimated
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings
from factorgraph_loc.sensors.odometry.settings import ImuSettings, OdometrySettings
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factorgraph_loc.sensors.twist.settings import TwistSettings
from factors.camera import model as reprojection
from factors.landmarks import model as bearing_range
from factors.odometry import model as odometry
from factors.odometry.model import OdometryModel

# m, rad, s: how long the error of a constant acts before what is seen corrects it
WAY, TURN, TIME = 4.0, 4.0, 8.0


class Rig(FileModel):
    """A robot: the sensors that estimators use by default, and the settings of each."""

    name: str = "rig"
    sensors: tuple[str, ...] = ("odometry", "bearing_range")
    odometry: OdometrySettings = OdometrySettings()
    imu: ImuSettings | None = None
    bearing_range: BearingRangeSettings | None = None
    rfid: RfidSettings | None = None
    twist: TwistSettings | None = None
    camera: CameraSettings | None = None
    camera_right: CameraSettings | None = None
    survey: SurveySettings = SurveySettings()

    def odometry_model(self, *, use_gyro: bool = False, constants_as_noise: bool = False) -> OdometryModel:
        """The motion model; with ``use_gyro`` the heading's noise and bias are those of the gyro.

        ``constants_as_noise``: for an estimator that does not estimate the uncertain constants, whose error then is in its
        noise: as of a random walk that after :data:`WAY`, :data:`TURN` or :data:`TIME` has the variance of the constant's effect.
        """
        s = self.odometry
        along, heading = s.noise.along.model(), s.noise.heading.model()
        if constants_as_noise:
            u = s.uncertainty
            along = along.widened(per_distance=u.scale_distance * math.sqrt(WAY))
            heading = heading.widened(
                per_distance=u.heading_drift * math.sqrt(WAY),
                per_rotation=u.scale_rotation * math.sqrt(TURN),
                per_time=u.heading_rate_bias * math.sqrt(TIME),
            )
        imu = self.imu or ImuSettings()
        return OdometryModel(
            scale_distance=s.scale_distance,
            scale_rotation=s.scale_rotation,
            speed_bias=s.speed_bias,
            heading_rate_bias=s.heading_rate_bias,
            heading_drift=s.heading_drift,
            direction=s.direction,
            delay=s.delay,
            lag=s.lag,
            turn_slowdown=s.turn_slowdown,
            gyro_bias=imu.bias,
            max_hold=s.max_hold,
            unknown_distance=s.unknown_distance,
            unknown_rotation=s.unknown_rotation,
            along=along,
            lateral=s.noise.lateral.model(),
            heading=imu.heading.model() if use_gyro else heading,
        )

    def estimated_odometry(self) -> Estimated:
        """Which of ``factors.odometry.model.PARAMETERS`` are estimated on the way."""
        return Estimated.of(odometry.PARAMETERS, self.odometry.uncertainty)

    def estimated_bearing_range(self) -> Estimated:
        """Which of ``factors.landmarks.model.PARAMETERS`` are estimated on the way."""
        return Estimated.of(bearing_range.PARAMETERS, self.bearing_range and self.bearing_range.uncertainty)

    def estimated_camera(self) -> Estimated:
        """Which of ``factors.camera.model.PARAMETERS`` are estimated on the way."""
        return Estimated.of(reprojection.PARAMETERS, self.camera and self.camera.uncertainty)

    def time_offset(self, sensor: str) -> float:
        """Seconds to add to the stamps of a sensor's stream; those of identified pixels are the cameras'."""
        settings = getattr(self, sensor.replace("sightings", "camera"), None)
        return 0.0 if settings is None else float(settings.time_offset)
