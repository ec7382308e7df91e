"""Validation of pushed wheel odometry."""

import math

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.measurement import Measurement, named
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.odometry.measurement import IncrementOdometry


class Increments:
    """Checks that increments are in order of time."""

    def __init__(self, rig: Rig, world: World) -> None:
        self._newest = -math.inf

    def require(self, m: Measurement) -> None:
        """InputError for an increment that goes back in time."""
        if not isinstance(m, IncrementOdometry):
            return
        if m.t < self._newest:
            raise InputError(f"{named(m)}: follows one at {self._newest:.3f} s, expected increments in order of time")
        self._newest = m.t
