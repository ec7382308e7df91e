"""Rig settings of a landmark sensor."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.model.settings import SensorSettings
from factorgraph_loc.model.units import Angle, Offset
from factors.landmarks.model import PARAMETERS, BearingRangeModel


class BearingRangeUncertainty(FileModel):
    """Standard deviations of constants that differ between robots or runs; those above 0 are estimated."""

    x: Annotated[float, Field(ge=0.0, le=10.0), InUnit("m")] = 0.0
    y: Annotated[float, Field(ge=0.0, le=10.0), InUnit("m")] = 0.0
    bearing_bias: Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad")] = 0.0
    range_scale: Annotated[float, Field(ge=0.0, le=1.0, description="relative")] = 0.0
    depth_axis: Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad")] = 0.0
    time_offset: Annotated[float, Field(ge=0.0, le=1.0), InUnit("s")] = 0.0


class BearingRangeSettings(SensorSettings):
    """A sensor of identified landmarks. See :class:`factors.landmarks.model.BearingRangeModel` for the model.

    A landmark with a survey sigma above ``exact_survey`` times ``range_sigma`` is estimated with its survey as prior; others are
    treated as exact.
    """

    constants: ClassVar[tuple[str, ...]] = PARAMETERS
    x: Offset = 0.0
    y: Offset = 0.0
    heading: Angle = 0.0
    bearing_bias: Angle = 0.0
    range_scale: Annotated[float, Field(ge=0.2, le=5.0, description="reported divided by true")] = 1.0
    range_kind: Annotated[Literal["distance", "depth"], Field(description="depth: along one axis only")] = "distance"
    depth_axis: Annotated[Angle, Field(description="of that axis, in the sensor frame")] = 0.0
    range_sigma: Annotated[float, Field(ge=1e-4, le=10.0), InUnit("m")]
    range_sigma_relative: Annotated[float, Field(ge=0.0, le=1.0), InUnit("m per m")] = 0.0
    bearing_sigma: Annotated[float, Field(ge=1e-5, le=0.5), InUnit("rad")] = 0.05
    robust: Annotated[float, Field(ge=0.01, le=100.0, description="scale of the Geman-McClure loss, in sigmas")] = 4.0
    exact_survey: Annotated[float, Field(ge=0.0, le=10.0, description="relative to range_sigma")] = 0.2
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
