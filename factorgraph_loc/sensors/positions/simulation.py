"""Simulates measured positions of a robot."""

import numpy as np

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.model.settings import Hertz
from factorgraph_loc.sensors.interfaces import Ride, Simulated
from factorgraph_loc.sensors.positions.measurement import PositionSettings, PositionStream
from factors import se2


class PositionSimulation(FileModel):
    """Settings of simulated positions. Positions are simulated if the rig has the section ``[position]``."""

    rate: Hertz = 5.0
    """measurements per second"""


def simulate(ride: Ride) -> Simulated:
    """Return measured positions of a simulated drive: true positions of a point on the robot, with Gaussian noise."""
    settings = ride.rig.find(PositionSettings)
    if settings is None:
        return Simulated()
    rng, t = ride.rng("position"), ride.times(ride.settings.positions.rate)
    exact = se2.transform_from(ride.truth.at(t), np.array((settings.x, settings.y)))
    x, y = (exact + settings.sigma * rng.standard_normal(exact.shape)).T
    unknown = np.full(len(t), np.nan)
    return Simulated({"position": PositionStream(t - settings.time_offset, x, y, unknown, unknown, unknown)})
