"""What a robot looks with, as expectations of what it will learn see it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.forecast import Forecast
from factorgraph_loc.sensors.odometry.model import odometry_model
from factorgraph_loc.sensors.registry import functions
from factors.odometry.model import OdometryModel
from factors.se2 import Array

SPEED = 0.5  # m/s, at which the odometry's noise that grows with time is taken
METRES_PER_RADIAN = 0.5  # of a robot that turns in place by 1 rad/s


@dataclass(frozen=True, eq=False)
class Sensors:
    """What a robot looks with on its way. ``odometry``: noise of its motion; ``forecasts``: of the sensors that find something in
    the map; ``metres_per_radian``: that take as long as a turn in place."""

    odometry: OdometryModel
    forecasts: tuple[Forecast, ...] = ()
    metres_per_radian: float = METRES_PER_RADIAN

    @property
    def goals(self) -> Array:
        """Places (K, 2) near which they tell most."""
        return np.concatenate([np.empty((0, 2)), *(one.goals for one in self.forecasts)])

    @staticmethod
    def of(
        world: World,
        rig: Rig,
        settings: Any = None,
        speed: float = SPEED,
        turn_rate: float = SPEED / METRES_PER_RADIAN,
        only: Collection[str] | None = None,
    ) -> Sensors:
        """All sensors of a rig that find something in the world, or ``only`` those of these names, with the rates of a simulation's
        ``settings``."""
        made = [
            forecast(world, rig, speed, settings)
            for name, forecast in functions("forecast")
            if only is None or name in only
        ]
        # those first that lead somewhere: sums depend on the order in their last digits
        found = sorted((one for one in made if one is not None), key=lambda one: not len(one.goals))
        return Sensors(odometry_model(rig, constants_as_noise=True), tuple(found), speed / turn_rate)
