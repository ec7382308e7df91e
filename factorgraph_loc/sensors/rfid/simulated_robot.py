"""Simulated RFID antennas of an active robot."""

from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.simulation_settings import FaultSettings
from factorgraph_loc.sensors.rfid.tag_map import tag_map
from factors.rfid.detection import RfidLikelihood
from factors.se2 import Array


class SimulatedReader:
    """A :class:`~factorgraph_loc.sensors.interfaces.LiveSensor`: all antennas measure one round at a time."""

    channel, decides = "rfid", True

    def __init__(self, world: World, rig: Rig, rate: float, rng: np.random.Generator) -> None:
        self.rate, self._rng = rate, rng
        self._antennas = tuple(rig.of(RfidSettings).all_antennas())
        self._map = tag_map(world, rig.of(SurveySettings))
        self._likelihood = RfidLikelihood(rig.of(RfidSettings).model(), self._map.tags)

    def measure(self, t: float, pose: Array) -> RfidScan:
        """A round that ends at ``t``."""
        chance = np.stack([self._likelihood.probabilities(pose[None], a)[0] for a in range(len(self._antennas))])
        antenna, tag = np.nonzero(self._rng.random(chance.shape) < chance)
        unknown = np.full(len(tag), np.nan)
        names = tuple(self._map.names[i] for i in tag.tolist())
        return RfidScan(
            t, self._antennas, antenna.astype(np.int64), names, np.zeros(len(tag)), unknown, unknown, unknown
        )


def on_robot(world: World, rig: Rig, settings: Any, rng: np.random.Generator) -> SimulatedReader:
    """The antennas of a rig; InputError if the settings have faults."""
    if settings.faults != FaultSettings():
        raise InputError(f"{settings.name}: has faults, which active runs do not support")
    return SimulatedReader(world, rig, settings.rounds_per_second, rng)
