"""What the robot carries, and what we believe about it, read from and written to ``NAME.rig.toml``.

Every number has its unit in the description; the bounds are there to catch wrong units (degrees for radians, mm for m).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.camera_settings import CameraSettings
from factorgraph_loc.files import FileModel, parse_model, read_toml, write_toml
from factorgraph_loc.grids import write_grid
from factorgraph_loc.rfid_settings import GridSettings, RfidSettings, SurveySettings
from factors import bearing_range, odometry, reprojection
from factors.bearing_range import BearingRangeModel
from factors.odometry import Growth, OdometryModel
from factors.se2 import Array

Angle = Annotated[float, Field(ge=-math.pi, le=math.pi, description="rad")]
Offset = Annotated[float, Field(ge=-10.0, le=10.0, description="m, in the robot's frame")]
Scale = Annotated[float, Field(ge=0.2, le=5.0, description="true over reported")]
Seconds = Annotated[float, Field(ge=-5.0, le=5.0, description="s")]
Rate = Annotated[float, Field(ge=-1.0, le=1.0, description="rad/s")]
Noise = Annotated[float, Field(ge=0.0, le=5.0)]

PerRootSecond = Annotated[float, Field(ge=1e-6, le=5.0, description="per sqrt(s)")]

# m, rad, s: how long the error of a constant acts before what is seen corrects it
WAY, TURN, TIME = 4.0, 4.0, 8.0


class GrowthSettings(FileModel):
    """Standard deviation per sqrt(m) travelled, per sqrt(rad) turned, per sqrt(s) passed."""

    per_distance: Noise = 0.0
    per_rotation: Noise = 0.0
    per_time: Noise = 0.0

    def model(self) -> Growth:
        return Growth(self.per_distance, self.per_rotation, self.per_time)


class OdometryNoise(FileModel):
    """How the error grows: along the track [m], across it [m], in heading [rad]. What is not given is that of wheels of which
    nothing is known, indoors."""

    along: GrowthSettings = GrowthSettings(per_distance=0.05, per_time=0.005)
    lateral: GrowthSettings = GrowthSettings(per_distance=0.02, per_time=0.005)
    heading: GrowthSettings = GrowthSettings(per_distance=0.05, per_rotation=0.05, per_time=0.002)


class OdometryUncertainty(FileModel):
    """Standard deviations of constants that differ between robots or runs; one above 0 is estimated on the way.

    Those of the scales are shares of the scale; that of the heading-rate bias is in rad/s, that of the drift in rad/m.
    """

    scale_distance: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    scale_rotation: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    heading_rate_bias: Annotated[float, Field(ge=0.0, le=1.0, description="rad/s")] = 0.0
    heading_drift: Annotated[float, Field(ge=0.0, le=1.0, description="rad/m")] = 0.0


class OdometrySettings(FileModel):
    """Wheel odometry. See :class:`factors.odometry.OdometryModel` for the model."""

    time_offset: Seconds = 0.0
    scale_distance: Scale = 1.0
    scale_rotation: Scale = 1.0
    speed_bias: Annotated[float, Field(ge=-1.0, le=1.0, description="m/s, what is reported at rest")] = 0.0
    heading_rate_bias: Rate = 0.0
    heading_drift: Annotated[float, Field(ge=-1.0, le=1.0, description="rad/m")] = 0.0
    direction: Angle = 0.0
    delay: Annotated[float, Field(ge=0.0, le=2.0, description="s")] = 0.0
    lag: Annotated[float, Field(ge=0.0, le=5.0, description="s")] = 0.0
    turn_slowdown: Annotated[float, Field(ge=0.0, le=5.0, description="m/rad")] = 0.0
    max_hold: Annotated[float, Field(ge=1e-3, le=60.0, description="s")] = 1.5
    unknown_distance: Noise = 0.2
    unknown_rotation: Noise = 0.2
    noise: OdometryNoise = OdometryNoise()
    uncertainty: OdometryUncertainty = OdometryUncertainty()


class ImuSettings(FileModel):
    """The gyro: its yaw rate replaces the rotation of the wheels where an estimator is given the sensor ``imu``, of a rig without
    these settings with the default ones."""

    time_offset: Seconds = 0.0
    bias: Rate = 0.0
    heading: GrowthSettings = GrowthSettings(per_time=0.005)


class TwistSettings(FileModel):
    """Measured motion in space. ``shift`` [m per sqrt(s)] and ``turn`` [rad per sqrt(s)]: standard deviations of the errors of
    position and orientation along the robot's axes, which grow with the root of time."""

    time_offset: Seconds = 0.0
    shift: tuple[PerRootSecond, PerRootSecond, PerRootSecond]
    turn: tuple[PerRootSecond, PerRootSecond, PerRootSecond]


class BearingRangeUncertainty(FileModel):
    """Standard deviations of constants that differ between robots or runs; one above 0 is estimated on the way."""

    x: Annotated[float, Field(ge=0.0, le=10.0, description="m")] = 0.0
    y: Annotated[float, Field(ge=0.0, le=10.0, description="m")] = 0.0
    bearing_bias: Annotated[float, Field(ge=0.0, le=1.0, description="rad")] = 0.0
    range_scale: Annotated[float, Field(ge=0.0, le=1.0, description="as a share")] = 0.0
    depth_axis: Annotated[float, Field(ge=0.0, le=1.0, description="rad")] = 0.0
    time_offset: Annotated[float, Field(ge=0.0, le=1.0, description="s")] = 0.0


class BearingRangeSettings(FileModel):
    """A sensor of identified landmarks. See :class:`factors.bearing_range.BearingRangeModel` for the model."""

    time_offset: Seconds = 0.0
    x: Offset = 0.0
    y: Offset = 0.0
    heading: Angle = 0.0
    bearing_bias: Angle = 0.0
    range_scale: Annotated[float, Field(ge=0.2, le=5.0, description="reported over true")] = 1.0
    range_kind: Annotated[Literal["distance", "depth"], Field(description="depth: along one axis only")] = "distance"
    depth_axis: Annotated[Angle, Field(description="of that axis, in the sensor's frame")] = 0.0
    range_sigma: Annotated[float, Field(ge=1e-4, le=10.0, description="m")]
    range_sigma_relative: Annotated[float, Field(ge=0.0, le=1.0, description="m per m of range")] = 0.0
    bearing_sigma: Annotated[float, Field(ge=1e-5, le=0.5, description="rad, not degrees")] = 0.05
    robust: Annotated[float, Field(ge=0.01, le=100.0, description="scale of the Geman-McClure loss, in sigmas")] = 4.0
    uncertainty: BearingRangeUncertainty = BearingRangeUncertainty()

    def model(self) -> BearingRangeModel:
        return BearingRangeModel(
            mounting=(self.x, self.y, self.heading),
            bearing_bias=self.bearing_bias,
            range_scale=self.range_scale,
            depth=self.range_kind == "depth",
            depth_axis=self.depth_axis,
            range_sigma=self.range_sigma,
            range_sigma_relative=self.range_sigma_relative,
            bearing_sigma=self.bearing_sigma,
            robust=self.robust,
        )


@dataclass(frozen=True)
class Estimated:
    """Constants of a sensor that an estimator learns, as changes from the rig's values.

    ``names`` (P,): of the constants; ``indices`` (P,): their places among all that could be; ``sigmas`` (P,): their priors'.
    """

    names: tuple[str, ...]
    indices: tuple[int, ...]
    sigmas: Array

    @staticmethod
    def of(names: Sequence[str], uncertainty: FileModel | None) -> Estimated:
        """Those of ``names`` whose uncertainty is above zero."""
        sigmas = np.array([getattr(uncertainty, name, 0.0) for name in names])
        indices = tuple(np.flatnonzero(sigmas).tolist())
        return Estimated(tuple(names[i] for i in indices), indices, sigmas[list(indices)])

    def full(self, values: Array, count: int) -> Array:
        """``values`` (..., P) among all ``count`` constants, the others zero."""
        out = np.zeros((*np.shape(values)[:-1], count))
        out[..., list(self.indices)] = values
        return out


NOTHING = Estimated((), (), np.zeros(0))


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
        """Which of ``factors.odometry.PARAMETERS`` are estimated on the way."""
        return Estimated.of(odometry.PARAMETERS, self.odometry.uncertainty)

    def estimated_bearing_range(self) -> Estimated:
        """Which of ``factors.bearing_range.PARAMETERS`` are estimated on the way."""
        return Estimated.of(bearing_range.PARAMETERS, self.bearing_range and self.bearing_range.uncertainty)

    def estimated_camera(self) -> Estimated:
        """Which of ``factors.reprojection.PARAMETERS`` are estimated on the way."""
        return Estimated.of(reprojection.PARAMETERS, self.camera and self.camera.uncertainty)

    def time_offset(self, sensor: str) -> float:
        """Seconds to add to the stamps of a sensor's stream; those of identified pixels are the cameras'."""
        settings = getattr(self, sensor.replace("sightings", "camera"), None)
        return 0.0 if settings is None else float(settings.time_offset)


def read_rig(path: str | Path) -> Rig:
    """Read ``NAME.rig.toml``; InputError names file, key and what is expected. Grids are looked for beside it."""
    path = Path(path)
    return placed(parse_model(Rig, read_toml(path), path), path.parent)


def placed(rig: Rig, folder: Path) -> Rig:
    """The rig, whose grids are files in ``folder``."""
    if rig.rfid is None:
        return rig
    models = {k: m.placed(folder) if isinstance(m, GridSettings) else m for k, m in rig.rfid.models.items()}
    return rig.model_copy(update={"rfid": rig.rfid.model_copy(update={"models": models})})


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write ``NAME.rig.toml``, and its grids beside it."""
    path = Path(path)
    for model in (rig.rfid.models if rig.rfid else {}).values():
        if isinstance(model, GridSettings) and model.path().resolve() != (path.parent / model.file).resolve():
            write_grid(model.model(), path.parent / model.file)
    write_toml(path, rig.model_dump(mode="json", exclude_none=True))
