"""The camera settings of a rig."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, model_validator

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.model.settings import SensorSettings
from factorgraph_loc.vision.settings import FrontendSettings
from factors.camera import model as reprojection
from factors.camera.model import CameraModel

Angle = Annotated[float, Field(ge=-math.pi, le=math.pi), InUnit("rad")]
Offset = Annotated[float, Field(ge=-10.0, le=10.0), InUnit("m")]
Focal = Annotated[float, Field(gt=1.0, le=1e5), InUnit("px")]
Pixel = Annotated[float, Field(ge=-1e5, le=1e5), InUnit("px")]
Lens = Annotated[float, Field(ge=-1000.0, le=1000.0)]
Side = Annotated[int, Field(ge=16, le=100_000), InUnit("px")]
Metres = Annotated[float, Field(ge=0.0, le=10.0), InUnit("m")]
Turn = Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad")]
WIDEST_ANGLE = math.degrees(math.atan(math.sqrt(reprojection.WIDEST)))


class CameraUncertainty(FileModel):
    """Standard deviations of constants that differ between robots or runs; those above 0 are estimated.

    ``roll``, ``pitch``, ``yaw``: rotations about the robot's axes; ``focal``: relative error of the focal length.
    """

    x: Metres = 0.0
    y: Metres = 0.0
    z: Metres = 0.0
    roll: Turn = 0.0
    pitch: Turn = 0.0
    yaw: Turn = 0.0
    focal: Annotated[float, Field(ge=0.0, le=1.0, description="relative")] = 0.0
    time_offset: Annotated[float, Field(ge=0.0, le=1.0), InUnit("s")] = 0.0


class CameraSettings(SensorSettings):
    """A camera. See :class:`factors.camera.model.CameraModel` for the model.

    Mounted at (x, y, z), it looks along the robot's x axis, rotated by ``roll`` about x, ``pitch`` about y (down is positive) and
    ``yaw`` about z (left is positive). ``time_offset`` [s] is added to the timestamps of its images. ``pixel_sigma`` [px] and
    ``robust``, the scale of Huber's loss in standard deviations, apply to a matched feature and include errors of lens and
    mounting. ``tempering`` applies to features matched with a map, because errors of map and features are correlated between
    images.
    """

    constants: ClassVar[tuple[str, ...]] = reprojection.PARAMETERS
    width: Side = 640
    height: Side = 480
    fx: Focal
    fy: Focal
    cx: Pixel
    cy: Pixel
    distortion: Annotated[tuple[Lens, Lens, Lens, Lens], Field(description="k1, k2, p1, p2 as in OpenCV")] = (
        0.0,
        0.0,
        0.0,
        0.0,
    )
    x: Offset = 0.0
    y: Offset = 0.0
    z: Offset = 0.0
    roll: Angle = 0.0
    pitch: Angle = 0.0
    yaw: Angle = 0.0
    pixel_sigma: Annotated[float, Field(ge=0.01, le=100.0), InUnit("px")] = 1.0
    robust: Annotated[float, Field(ge=0.01, le=100.0, description="scale of Huber's loss, in sigmas")] = 2.0
    tempering: Annotated[float, Field(ge=1e-6, le=1.0, description="exponent of the likelihood")] = 0.03
    frontend: FrontendSettings = FrontendSettings()
    uncertainty: CameraUncertainty = CameraUncertainty()

    @model_validator(mode="after")
    def _is_invertible(self) -> CameraSettings:
        pixel = reprojection.folded(self.model())
        if pixel is not None:
            raise ValueError(
                f"the distortion {self.distortion} cannot be inverted at the pixel ({pixel[0]:g}, {pixel[1]:g}), expected a lens "
                f"that neither folds its image nor sees more than {WIDEST_ANGLE:.0f} degrees off its axis"
            )
        return self

    def model(self) -> CameraModel:
        return CameraModel(
            fx=self.fx,
            fy=self.fy,
            cx=self.cx,
            cy=self.cy,
            width=self.width,
            height=self.height,
            distortion=self.distortion,
            position=np.array((self.x, self.y, self.z)),
            rotation=reprojection.mounting(self.roll, self.pitch, self.yaw),
            sigma=self.pixel_sigma,
            robust=self.robust,
            tempering=self.tempering,
        )
