"""Bounded numbers for simulation settings."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import InUnit

Metres = Annotated[float, Field(ge=1e-3, le=1000.0), InUnit("m")]
Seconds = Annotated[float, Field(ge=0.0, le=1e5), InUnit("s")]
Hertz = Annotated[float, Field(ge=1e-3, le=100.0), InUnit("1/s")]
Share = Annotated[float, Field(ge=0.0, lt=1.0)]
