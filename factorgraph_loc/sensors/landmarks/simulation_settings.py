"""Simulation settings of a landmark sensor."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.model.settings import Hertz, Metres


class SightingSettings(FileModel):
    """Visibility of landmarks: ``rate`` measurements per second, up to ``max_range``, within ``field_of_view`` [rad] about the
    sensor's axis, and not through walls."""

    rate: Hertz = 2.0
    max_range: Metres = 6.0
    field_of_view: Annotated[float, Field(ge=0.01, le=6.3), InUnit("rad")] = 6.3
