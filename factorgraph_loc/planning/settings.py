"""Settings of an active run: the robot, when it counts as localized, and the policy."""

import math
from typing import Annotated, Literal

from pydantic import Field, field_validator

from factorgraph_loc.files.models import FileModel, InUnit

Metres = Annotated[float, Field(ge=1e-3, le=1000.0), InUnit("m")]
Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)]
Dimension = Literal["x", "y", "heading"]


class PolicySettings(FileModel):
    """How the next path is chosen. ``horizon`` [m]: length of arcs and straight paths; ``far`` [m]: of the longest paths to
    places. ``replan`` [m]: least distance driven before choosing again (half of a longer arc, the whole path to a place).
    ``per_metre`` and ``per_second``: cost of a near path in nats; far ones cost per second only. ``samples``: number of particles
    for the expectation. ``dimensions``: whose entropy counts. ``expectation``: over sampled scans or, for a unimodal belief, by
    the Fisher information in closed form.
    """

    horizon: Annotated[float, Field(gt=0.0, le=100.0), InUnit("m")] = 3.0
    far: Metres = 25.0
    replan: Metres = 0.5
    per_metre: Annotated[float, Field(ge=0.0, le=100.0), InUnit("nats/m")] = 0.3
    expectation: Literal["sampled", "fisher"] = "sampled"
    per_second: Annotated[float, Field(ge=0.0, le=100.0), InUnit("nats/s")] = 0.0
    samples: Annotated[int, Field(ge=8, le=10_000)] = 128
    dimensions: tuple[Dimension, ...] = ("x", "y", "heading")

    @field_validator("dimensions")
    @classmethod
    def _with_position(cls, value: tuple[Dimension, ...]) -> tuple[Dimension, ...]:
        if value not in (("x", "y"), ("x", "y", "heading")):
            raise ValueError("expected x, y or x, y, heading")
        return value


class ActiveSettings(FileModel):
    """Settings of an active run. ``policy``: see :class:`PolicySettings`. ``particles``: of ``active_mcl``.

    ``speed`` and ``turn_rate`` of the robot; ``clearance`` [m]: least distance from walls; ``sight`` [m]: range of its proximity
    sensor. ``start``: the true (x, y, heading), by default random in free space. The robot is localized once the standard
    deviations of position (along the longest axis) and heading, and the errors, are below ``position_limit`` [m] and
    ``heading_limit`` [rad]. It gives up after ``max_metres`` or ``max_seconds``.
    """

    policy: PolicySettings = PolicySettings()
    particles: Annotated[int, Field(ge=100, le=100_000)] = 2000
    speed: Annotated[float, Field(ge=0.01, le=3.0), InUnit("m/s")] = 0.5
    turn_rate: Annotated[float, Field(ge=0.01, le=6.0), InUnit("rad/s")] = 1.0
    clearance: Annotated[float, Field(ge=0.05, le=2.0), InUnit("m")] = 0.35
    sight: Metres = 3.0
    start: tuple[Coordinate, Coordinate, Coordinate] | None = None
    position_limit: Metres = 0.3
    heading_limit: Annotated[float, Field(gt=0.0, le=math.pi), InUnit("rad")] = math.radians(10.0)
    max_metres: Metres = 100.0
    max_seconds: Annotated[float, Field(gt=0.0, le=36_000.0), InUnit("s")] = 600.0
