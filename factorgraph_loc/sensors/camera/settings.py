"""The camera settings of a rig, with those of feature detection, and the settings of simulated pixels."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.maps.points import CommonError, Feature
from factorgraph_loc.model.settings import Angle, Hertz, Offset, SensorSettings, Share
from factors.camera import model as reprojection
from factors.camera.model import CameraModel
from factors.se2 import Array

if TYPE_CHECKING:
    from factorgraph_loc.model.world import World


Focal = Annotated[float, Field(gt=1.0, le=1e5), InUnit("px")]
Pixel = Annotated[float, Field(ge=-1e5, le=1e5), InUnit("px")]
Lens = Annotated[float, Field(ge=-1000.0, le=1000.0)]
Side = Annotated[int, Field(ge=16, le=100_000), InUnit("px")]
Distance = Annotated[float, Field(ge=0.0, le=10.0), InUnit("m")]
Turn = Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad")]
COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}  # of distortion
WIDEST_ANGLE = math.degrees(math.atan(math.sqrt(reprojection.WIDEST)))


class FrontendSettings(FileModel):
    """Settings of the detection of features and markers."""

    feature: Feature = "colour"
    """kind of feature to detect, if the map's points have no descriptors"""
    count: Annotated[int, Field(ge=10, le=20_000)] = 500
    """largest number of features per image"""
    everywhere: bool = False
    """whether all parts of an image have equally many features, if possible, not the strongest ones; always so without a map of
    points
    """


class CameraUncertainty(FileModel):
    """Standard deviations of constants that differ between robots or runs; those above 0 are estimated."""

    x: Distance = 0.0
    """standard deviation of the constant"""
    y: Distance = 0.0
    """standard deviation of the constant"""
    z: Distance = 0.0
    """standard deviation of the constant"""
    roll: Turn = 0.0
    """standard deviation of a rotation about the robot's x axis"""
    pitch: Turn = 0.0
    """standard deviation of a rotation about the robot's y axis"""
    yaw: Turn = 0.0
    """standard deviation of a rotation about the robot's z axis"""
    focal: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """standard deviation of the focal length, relative"""
    time_offset: Annotated[float, Field(ge=0.0, le=1.0), InUnit("s")] = 0.0
    """standard deviation of the constant"""


class CameraSettings(SensorSettings):
    """A camera. See :class:`factors.camera.model.CameraModel` for the model."""

    constants: ClassVar[tuple[str, ...]] = reprojection.PARAMETERS
    width: Side = 640
    """width of the images"""
    height: Side = 480
    """height of the images"""
    fx: Focal
    """focal length in pixels along a row"""
    fy: Focal
    """focal length in pixels along a column"""
    cx: Pixel
    """principal point; 0 is the centre of the upper left pixel"""
    cy: Pixel
    """principal point; 0 is the centre of the upper left pixel"""
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant"] = "plumb_bob"
    """kind of lens, as in ROS; equidistant is OpenCV's fisheye"""
    distortion: Annotated[tuple[Lens, ...], Field(min_length=4, max_length=8)] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2 as in OpenCV, and k3, or k3 to k6; k1 to k4 of equidistant"""
    x: Offset = 0.0
    """position of the camera on the robot, forward"""
    y: Offset = 0.0
    """position of the camera on the robot, to the left"""
    z: Offset = 0.0
    """height of the camera"""
    roll: Angle = 0.0
    """rotation about the robot's x axis, first, from looking forward"""
    pitch: Angle = 0.0
    """rotation about the robot's y axis, then; down is positive"""
    yaw: Angle = 0.0
    """rotation about the robot's z axis, last; left is positive"""
    pixel_sigma: Annotated[float, Field(ge=0.01, le=100.0), InUnit("px")] = 1.0
    """standard deviation of a matched feature, including errors of lens and mounting"""
    robust: Annotated[float, Field(ge=0.01, le=100.0)] = 2.0
    """scale of Huber's loss, in standard deviations"""
    tempering: Annotated[float, Field(ge=1e-6, le=1.0)] = 0.03
    """exponent of the likelihood of features matched with a map, whose errors are correlated between images"""
    frontend: FrontendSettings = FrontendSettings()
    """features that are detected in images"""
    uncertainty: CameraUncertainty = CameraUncertainty()
    """standard deviations of constants; those above 0 are estimated"""

    @model_validator(mode="after")
    def _has_its_numbers(self) -> CameraSettings:
        counts = COUNTS[self.distortion_model]
        if len(self.distortion) not in counts:
            expected = " or ".join(map(str, counts))
            raise ValueError(
                f"the distortion has {len(self.distortion)} numbers, {self.distortion_model} has {expected}"
            )
        return self

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
            distortion=self.distortion[:4] if not any(self.distortion[4:]) else (*self.distortion, 0.0, 0.0, 0.0)[:8],
            fisheye=self.distortion_model == "equidistant",
            position=np.array((self.x, self.y, self.z)),
            rotation=reprojection.mounting(self.roll, self.pitch, self.yaw),
            sigma=self.pixel_sigma,
            robust=self.robust,
            tempering=self.tempering,
        )

    def map_error(self, world: World) -> Callable[[Array], Array] | None:
        common = None if world.points is None else CommonError.of(world.points)
        if common is None:
            return None
        ahead = self.model().rotation[:, 2]
        return partial(common.at, looking=math.atan2(ahead[1], ahead[0]))


class PixelSettings(FileModel):
    """Detection of named points."""

    rate: Hertz = 5.0
    """observations per second"""
    max_points: Annotated[int, Field(ge=1, le=10_000)] = 20
    """most points per image, chosen at random among the visible ones"""
    wrong: Share = 0.0
    """share of points that are reported at a random pixel"""
