"""Rig settings of measured motion in space."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import InUnit
from factorgraph_loc.model.settings import SensorSettings

PerRootSecond = Annotated[float, Field(ge=1e-6, le=5.0), InUnit("per sqrt(s)")]


class TwistSettings(SensorSettings):
    """Measured motion in space. ``shift`` [m per sqrt(s)] and ``turn`` [rad per sqrt(s)]: random walk of position and orientation
    along the robot's axes."""

    shift: tuple[PerRootSecond, PerRootSecond, PerRootSecond]
    turn: tuple[PerRootSecond, PerRootSecond, PerRootSecond]
