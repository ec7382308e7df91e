"""What may be set of an active run: the robot, when it knows its place, and how a policy chooses."""

import math
from typing import Annotated, Literal

from pydantic import Field, field_validator

from factorgraph_loc.files.models import FileModel

Metres = Annotated[float, Field(ge=1e-3, le=1000.0, description="m")]
Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)]
Dimension = Literal["x", "y", "heading"]


class PolicySettings(FileModel):
    """How the next way is chosen. ``horizon`` [m]: length of arcs and straight runs; ``far`` [m]: of the longest ways to places.
    ``replan`` [m]: how far the robot goes at least before it chooses anew: half of a longer arc, and all of a way to a place, which
    would be turned back from for less. ``per_metre`` and ``per_second``: what a near way costs, in nats; of far ones the seconds
    cost as much.
    ``samples``: particles of the belief that the expectation is taken over. ``dimensions``: whose entropy counts.
    ``expectation``: over scans that are drawn, or, of a belief in one place, by Fisher's information in closed form."""

    horizon: Annotated[float, Field(gt=0.0, le=100.0, description="m")] = 3.0
    far: Metres = 25.0
    replan: Metres = 0.5
    per_metre: Annotated[float, Field(ge=0.0, le=100.0, description="nats per m")] = 0.3
    expectation: Literal["sampled", "fisher"] = "sampled"
    per_second: Annotated[float, Field(ge=0.0, le=100.0, description="nats per s")] = 0.0
    samples: Annotated[int, Field(ge=8, le=10_000)] = 128
    dimensions: tuple[Dimension, ...] = ("x", "y", "heading")

    @field_validator("dimensions")
    @classmethod
    def _with_position(cls, value: tuple[Dimension, ...]) -> tuple[Dimension, ...]:
        if value not in (("x", "y"), ("x", "y", "heading")):
            raise ValueError("expected x, y or x, y, heading")
        return value


class ActiveSettings(FileModel):
    """An active run. ``policy``: see :class:`PolicySettings`. ``particles``: of ``active_mcl``.

    ``speed`` and ``turn_rate`` of the robot; ``clearance`` [m] to walls, nearer than which it does not go; ``sight`` [m]: how far
    its proximity sensor sees them. ``start``: the true (x, y, heading), by default anywhere in free space. The robot knows its
    place once the standard deviations of position (along the longest axis) and heading are below ``position_limit`` [m] and
    ``heading_limit`` [rad], and its errors too. It gives up after ``max_metres`` or ``max_seconds``.
    """

    policy: PolicySettings = PolicySettings()
    particles: Annotated[int, Field(ge=100, le=100_000)] = 2000
    speed: Annotated[float, Field(ge=0.01, le=3.0, description="m/s")] = 0.5
    turn_rate: Annotated[float, Field(ge=0.01, le=6.0, description="rad/s")] = 1.0
    clearance: Annotated[float, Field(ge=0.05, le=2.0, description="m")] = 0.35
    sight: Metres = 3.0
    start: tuple[Coordinate, Coordinate, Coordinate] | None = None
    position_limit: Metres = 0.3
    heading_limit: Annotated[float, Field(gt=0.0, le=math.pi, description="rad, not degrees")] = math.radians(10.0)
    max_metres: Metres = 100.0
    max_seconds: Annotated[float, Field(gt=0.0, le=36_000.0, description="s")] = 600.0
