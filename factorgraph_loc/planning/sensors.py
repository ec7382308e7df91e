"""The sensors of a robot as used for the prediction of information."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.interfaces import Forecast
from factorgraph_loc.sensors.motion import odometry_model
from factorgraph_loc.sensors.registry import functions
from factors.odometry.model import OdometryModel
from factors.se2 import Array

SPEED = 0.5  # m/s: converts noise of the odometry per second to noise per metre
METRES_PER_RADIAN = 0.5  # of a robot that turns in place at 1 rad/s


@dataclass(frozen=True, eq=False)
class Sensors:
    """``odometry``: noise of the motion; ``forecasts``: of the sensors that observe objects in the map; ``metres_per_radian``:
    distance driven in the time of a turn by one radian.
    """

    odometry: OdometryModel
    forecasts: tuple[Forecast, ...] = ()
    metres_per_radian: float = METRES_PER_RADIAN

    @property
    def goals(self) -> Array:
        """Places (K, 2) near which the sensors are most informative."""
        return np.concatenate([np.empty((0, 2)), *(forecast.goals for forecast in self.forecasts)])

    @staticmethod
    def of(
        world: World,
        rig: Rig,
        settings: Any = None,
        speed: float = SPEED,
        turn_rate: float = SPEED / METRES_PER_RADIAN,
        only: Collection[str] | None = None,
    ) -> Sensors:
        """All sensors of a rig that observe objects in the world, or ``only`` those with these names, with the rates in a
        simulation's ``settings``.
        """
        made = [
            forecast(world, rig, speed, settings)
            for name, forecast in functions("forecast")
            if only is None or name in only
        ]
        # those with goals first: the order affects the rounding of sums
        forecasts = sorted((f for f in made if f is not None), key=lambda f: not len(f.goals))
        return Sensors(odometry_model(rig, constants_as_noise=True), tuple(forecasts), speed / turn_rate)
