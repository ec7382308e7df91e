"""Settings of a rig's camera, of feature detection, and of simulated points in images."""

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
COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}  # possible numbers of coefficients
WIDEST_ANGLE = math.degrees(math.atan(math.sqrt(reprojection.WIDEST)))


class FrontendSettings(FileModel):
    """Settings of feature detection in images."""

    feature: Feature = "colour"
    """kind of feature to detect, if the points of the map do not determine it"""
    count: Annotated[int, Field(ge=10, le=20_000)] = 500
    """largest number of features per image"""
    everywhere: bool = False
    """spread the features evenly over the image instead of using the strongest ones; always true without a map of points"""


class CameraUncertainty(FileModel):
    """Standard deviations of calibration constants of the camera before a run. Constants with values above 0 are
    estimated."""

    x: Distance = 0.0
    """standard deviation of the camera's x"""
    y: Distance = 0.0
    """standard deviation of the camera's y"""
    z: Distance = 0.0
    """standard deviation of the camera's height"""
    roll: Turn = 0.0
    """standard deviation of a rotation about the robot's x axis"""
    pitch: Turn = 0.0
    """standard deviation of a rotation about the robot's y axis"""
    yaw: Turn = 0.0
    """standard deviation of a rotation about the robot's z axis"""
    focal: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """relative standard deviation of the focal length"""
    time_offset: Annotated[float, Field(ge=0.0, le=1.0), InUnit("s")] = 0.0
    """standard deviation of the time offset"""


class CameraSettings(SensorSettings):
    """Image size, lens, mounting and noise of a camera. The model is :class:`factors.camera.model.CameraModel`."""

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
    """column of the principal point; 0 is the centre of the left pixels"""
    cy: Pixel
    """row of the principal point; 0 is the centre of the upper pixels"""
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant"] = "plumb_bob"
    """kind of lens, as in ROS; equidistant is OpenCV's fisheye"""
    distortion: Annotated[tuple[Lens, ...], Field(min_length=4, max_length=8)] = (0.0, 0.0, 0.0, 0.0)
    """coefficients as in OpenCV: k1, k2, p1, p2, then k3 or k3 to k6; of an equidistant lens k1 to k4"""
    x: Offset = 0.0
    """position of the camera on the robot, forward"""
    y: Offset = 0.0
    """position of the camera on the robot, to the left"""
    z: Offset = 0.0
    """height of the camera"""
    roll: Angle = 0.0
    """first rotation of a camera with the optical axis forward, about the robot's x axis"""
    pitch: Angle = 0.0
    """second rotation, about the robot's y axis; down is positive"""
    yaw: Angle = 0.0
    """third rotation, about the robot's z axis; left is positive"""
    pixel_sigma: Annotated[float, Field(ge=0.01, le=100.0), InUnit("px")] = 1.0
    """standard deviation of a pixel coordinate, including errors of lens and mounting"""
    robust: Annotated[float, Field(ge=0.01, le=100.0)] = 2.0
    """scale of Huber's loss, in standard deviations"""
    tempering: Annotated[float, Field(ge=1e-6, le=1.0)] = 0.03
    """exponent of the likelihood of features matched with a map, whose errors are correlated between images"""
    frontend: FrontendSettings = FrontendSettings()
    """settings of feature detection"""
    uncertainty: CameraUncertainty = CameraUncertainty()
    """standard deviations of constants; a constant is estimated if its value is above 0"""

    @model_validator(mode="after")
    def _has_its_numbers(self) -> CameraSettings:
        counts = COUNTS[self.distortion_model]
        if len(self.distortion) not in counts:
            expected = " or ".join(map(str, counts))
            raise ValueError(
                f"distortion has {len(self.distortion)} numbers, expected {expected} for a {self.distortion_model} lens"
            )
        return self

    @model_validator(mode="after")
    def _is_invertible(self) -> CameraSettings:
        pixel = reprojection.folded(self.model())
        if pixel is not None:
            raise ValueError(
                f"the distortion {self.distortion} cannot be inverted at the pixel ({pixel[0]:g}, {pixel[1]:g}), expected "
                f"coefficients that can be inverted in the whole image, up to {WIDEST_ANGLE:.0f} degrees off the axis"
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
    """Settings of named points in simulated images."""

    rate: Hertz = 5.0
    """images per second"""
    max_points: Annotated[int, Field(ge=1, le=10_000)] = 20
    """largest number of points per image, chosen at random among the visible ones"""
    wrong: Share = 0.0
    """fraction of points that are reported at a random pixel"""
