"""Simulation of a compass."""

from compass.settings import CompassSettings
from compass.stream import HeadingStream
from factorgraph_loc.sensors.interfaces import Ride, Simulated
from factors import se2


def simulate(ride: Ride) -> Simulated:
    """Headings with the rig's bias, a random bias from its uncertainty, and noise."""
    compass = ride.rig.find(CompassSettings)
    if compass is None:
        return Simulated()
    rng, times = ride.rng("compass"), ride.times(ride.settings.compass.rate)
    bias = compass.bias + compass.uncertainty.bias * rng.standard_normal()
    heading = ride.truth.at(times)[:, 2] + bias + compass.sigma * rng.standard_normal(len(times))
    return Simulated({"compass": HeadingStream(times - compass.time_offset, se2.wrap(heading))})
