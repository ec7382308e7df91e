"""Rig settings of loops."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import InUnit
from factorgraph_loc.model.settings import SensorSettings


class LoopSettings(SensorSettings):
    """Loops found by another program. A loop of score s has standard deviations 1/s times as large as these, and is given up at
    sqrt(s) times the distance; a rig without the section has the defaults."""

    sigma_position: Annotated[float, Field(ge=1e-4, le=10.0), InUnit("m")] = 0.1
    """standard deviation of a relative position, in each coordinate"""
    sigma_heading: Annotated[float, Field(ge=1e-4, le=3.0), InUnit("rad")] = 0.05
    """standard deviation of a relative heading"""
    sigma_place: Annotated[float, Field(ge=1e-3, le=100.0), InUnit("m")] = 0.5
    """standard deviation, in each coordinate, of the distance between two poses at one place, for loops without a relative
    pose"""
    least_score: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """loops with a lower score are not used"""
    robust: Annotated[float, Field(ge=0.01, le=100.0)] = 3.0
    """scale of the Geman-McClure loss of a loop of score 1, in standard deviations"""
