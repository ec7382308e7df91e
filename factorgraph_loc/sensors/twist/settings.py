"""Rig settings of measured motion in space."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import InUnit
from factorgraph_loc.model.settings import SensorSettings

PerRootSecond = Annotated[float, Field(ge=1e-6, le=5.0), InUnit("per sqrt(s)")]


class TwistSettings(SensorSettings):
    """Measured motion in space."""

    shift: tuple[PerRootSecond, PerRootSecond, PerRootSecond]
    """random walk of the position along the robot's axes [m per sqrt(s)]"""
    turn: tuple[PerRootSecond, PerRootSecond, PerRootSecond]
    """random walk of the orientation about the robot's axes [rad per sqrt(s)]"""
