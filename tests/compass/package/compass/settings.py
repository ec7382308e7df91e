"""Settings of a compass."""

from typing import Annotated, ClassVar

from pydantic import Field

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.model.settings import Angle, Hertz, SensorSettings


class CompassUncertainty(FileModel):
    """Standard deviation of the bias, which is estimated if it is above 0."""

    bias: Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad")] = 0.0
    """standard deviation of the constant"""


class CompassSettings(SensorSettings):
    """A compass."""

    constants: ClassVar[tuple[str, ...]] = ("bias",)
    bias: Angle = 0.0
    """reported minus true heading"""
    sigma: Annotated[float, Field(ge=1e-4, le=1.0), InUnit("rad")] = 0.02
    """standard deviation of a measurement"""
    uncertainty: CompassUncertainty = CompassUncertainty()
    """standard deviations of constants; those above 0 are estimated"""


class CompassSimulation(FileModel):
    """The compass of a simulated robot."""

    rate: Hertz = 2.0
    """measurements per second"""
