"""Settings of an active run: the robot, when it counts as localized, and the policy."""

import math
from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import FileModel, InUnit

Metres = Annotated[float, Field(ge=1e-3, le=1000.0), InUnit("m")]
Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)]


class PolicySettings(FileModel):
    """How the next path is chosen."""

    horizon: Annotated[float, Field(gt=0.0, le=100.0), InUnit("m")] = 3.0
    """length of arcs and straight paths"""
    far: Metres = 25.0
    """length of the longest paths to places"""
    replan: Metres = 0.5
    """least distance driven before choosing again: half of a longer arc, the whole path to a place"""
    per_metre: Annotated[float, Field(ge=0.0, le=100.0), InUnit("nats/m")] = 0.3
    """cost of a near path by its length; far ones have none"""
    samples: Annotated[int, Field(ge=8, le=10_000)] = 128
    """number of particles for the expectation"""


class ActiveSettings(FileModel):
    """Settings of an active run. The robot is localized once the standard deviations of position (along the longest axis) and
    heading, and the errors, are below the limits."""

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
    """the true x, y, heading at the start, such as [4.0, 3.0, 0.5]; by default random in free space"""
    position_limit: Metres = 0.3
    """largest deviation and error of the position of a robot that is localized"""
    heading_limit: Annotated[float, Field(gt=0.0, le=math.pi), InUnit("rad")] = math.radians(10.0)
    """largest deviation and error of its heading"""
    max_metres: Metres = 100.0
    """distance after which the robot gives up"""
    max_seconds: Annotated[float, Field(gt=0.0, le=36_000.0), InUnit("s")] = 600.0
    """time after which it gives up"""
