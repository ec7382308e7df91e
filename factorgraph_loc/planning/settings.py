"""Settings of robot, limits of localization and policy in an active run. The simulated robot chooses its paths."""

import math
from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import FileModel, InUnit

Metres = Annotated[float, Field(ge=1e-3, le=1000.0), InUnit("m")]
Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)]


class PolicySettings(FileModel):
    """Settings of the policy that chooses the next path."""

    horizon: Annotated[float, Field(gt=0.0, le=100.0), InUnit("m")] = 3.0
    """length of arcs and straight paths"""
    far: Metres = 25.0
    """largest length of paths to distant tags and places"""
    replan: Metres = 0.5
    """least distance driven before the next choice; at least half of an arc is driven, and all of a path to a distant place"""
    per_metre: Annotated[float, Field(ge=0.0, le=100.0), InUnit("nats/m")] = 0.3
    """cost of the length of an arc or straight path"""
    samples: Annotated[int, Field(ge=8, le=10_000)] = 128
    """number of particles for the expected information"""


class ActiveSettings(FileModel):
    """Settings of an active run. The robot is localized once the standard deviations and the errors of position and
    heading are below the limits. The standard deviation of the position is measured in its least certain direction."""

    policy: PolicySettings = PolicySettings()
    particles: Annotated[int, Field(ge=100, le=100_000)] = 2000
    """least number of particles of active_mcl"""
    speed: Annotated[float, Field(ge=0.01, le=3.0), InUnit("m/s")] = 0.5
    """speed of the robot"""
    turn_rate: Annotated[float, Field(ge=0.01, le=6.0), InUnit("rad/s")] = 1.0
    """turn rate of the robot"""
    clearance: Annotated[float, Field(ge=0.05, le=2.0), InUnit("m")] = 0.35
    """least distance from walls"""
    sight: Metres = 3.0
    """range of the proximity sensor"""
    start: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """true x, y, heading at the start, such as [4.0, 3.0, 0.5]; by default random in free space"""
    position_limit: Metres = 0.3
    """largest standard deviation and position error of a localized robot"""
    heading_limit: Annotated[float, Field(gt=0.0, le=math.pi), InUnit("rad")] = math.radians(10.0)
    """largest standard deviation and heading error of a localized robot"""
    max_metres: Metres = 100.0
    """the robot gives up after this distance"""
    max_seconds: Annotated[float, Field(gt=0.0, le=36_000.0), InUnit("s")] = 600.0
    """the robot gives up after this time"""
