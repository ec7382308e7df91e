"""The motion model of a rig."""

import math

from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.odometry.settings import ImuSettings, OdometrySettings
from factors.odometry.model import OdometryModel

# m, rad, s: over which the error of a constant accumulates before other sensors correct it
WAY, TURN, TIME = 4.0, 4.0, 8.0


def odometry_model(rig: Rig, *, use_gyro: bool = False, constants_as_noise: bool = False) -> OdometryModel:
    """The motion model; with ``use_gyro`` the heading's noise and bias are those of the gyro.

    ``constants_as_noise``: for an estimator that does not estimate the uncertain constants: their errors are part of the noise,
    as a random walk that reaches the variance of the constant's effect after :data:`WAY`, :data:`TURN` or :data:`TIME`.
    """
    s = rig.of(OdometrySettings)
    along, heading = s.noise.along.model(), s.noise.heading.model()
    if constants_as_noise:
        u = s.uncertainty
        along = along.widened(per_distance=u.scale_distance * math.sqrt(WAY))
        heading = heading.widened(
            per_distance=u.heading_drift * math.sqrt(WAY),
            per_rotation=u.scale_rotation * math.sqrt(TURN),
            per_time=u.heading_rate_bias * math.sqrt(TIME),
        )
    imu = rig.find(ImuSettings) or ImuSettings()
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
