"""Bounded numbers of settings with their units; the bounds reject wrong units (degrees for radians, mm for m)."""

import math
from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import InUnit

Angle = Annotated[float, Field(ge=-math.pi, le=math.pi), InUnit("rad")]
Offset = Annotated[float, Field(ge=-10.0, le=10.0), InUnit("m")]
Scale = Annotated[float, Field(ge=0.2, le=5.0)]
Seconds = Annotated[float, Field(ge=-5.0, le=5.0), InUnit("s")]
Rate = Annotated[float, Field(ge=-1.0, le=1.0), InUnit("rad/s")]
Noise = Annotated[float, Field(ge=0.0, le=5.0)]
