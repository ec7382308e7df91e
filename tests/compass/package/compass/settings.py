"""Settings of a compass."""

from typing import Annotated, ClassVar

from pydantic import Field

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.model.settings import SensorSettings
from factorgraph_loc.model.simulation_units import Hertz
from factorgraph_loc.model.units import Angle


class CompassUncertainty(FileModel):
    """Standard deviation of the bias, which is estimated if it is above 0."""

    bias: Annotated[float, Field(ge=0.0, le=1.0, description="rad")] = 0.0


class CompassSettings(SensorSettings):
    """A compass. ``bias``: reported minus true heading; ``sigma``: noise of one measurement."""

    constants: ClassVar[tuple[str, ...]] = ("bias",)
    bias: Angle = 0.0
    sigma: Annotated[float, Field(ge=1e-4, le=1.0, description="rad, not degrees")] = 0.02
    uncertainty: CompassUncertainty = CompassUncertainty()


class CompassSimulation(FileModel):
    """``rate``: measurements per second."""

    rate: Hertz = 2.0
