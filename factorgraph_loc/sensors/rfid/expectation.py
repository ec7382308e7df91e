"""Expected information of RFID antennas along a path, for planning."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.interfaces import Array32, Places
from factorgraph_loc.sensors.rfid.forecast import ScanTables, log_weights, make_tables
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.tag_map import tag_map
from factors.rfid.counts import TagReadCounts
from factors.rfid.detection import RfidLikelihood
from factors.se2 import Array

ROUNDS_PER_SECOND = 2.0  # default rate


@dataclass(frozen=True, eq=False)
class RfidForecast:
    """A :class:`~factorgraph_loc.sensors.interfaces.Forecast` of inventory rounds, ``rounds_per_metre`` of each antenna."""

    likelihood: RfidLikelihood
    rounds_per_metre: float = 4.0

    @property
    def goals(self) -> Array:
        """The positions of the tags."""
        return self.likelihood.tags.points[:, :2]

    @cached_property
    def _tables(self) -> ScanTables:
        return make_tables(self.likelihood)

    def information(self, poses: Array, ways: Array) -> Array:
        """Expected information, proportional to the number of rounds."""
        count = len(self.likelihood.model.antennas)
        hits = np.zeros((count, len(self.likelihood.tags.points)), dtype=np.int64)
        one_round = TagReadCounts(np.zeros((count, 3)), np.arange(count), np.ones(count, dtype=np.int64), hits)
        found = self.likelihood.score(poses, one_round).information
        return np.asarray((self.rounds_per_metre * ways)[:, None, None] * found)

    def add_log_weights(self, poses: Array, metres: float, stops: Places, seed: np.uint64, out: Array32) -> None:
        """Weigh particles by simulated scans, with the path's rounds distributed over the poses."""
        looks, total = len(poses), round(metres * self.rounds_per_metre)
        rounds = np.diff(np.arange(looks + 1) * total // looks).astype(np.int64)
        found = np.empty_like(out)
        tempering = self.likelihood.model.tempering
        log_weights(self._tables, poses, rounds, stops, len(out), seed, tempering, found)
        out += found


def forecast(world: World, rig: Rig, speed: float, settings: Any = None) -> RfidForecast | None:
    """The forecast for a robot with ``speed`` [m/s], with the rates of a simulation; None without antennas or tags."""
    if rig.find(RfidSettings) is None or not world.tags:
        return None
    rate = ROUNDS_PER_SECOND if settings is None else settings.rounds_per_second
    return RfidForecast(
        RfidLikelihood(rig.of(RfidSettings).model(), tag_map(world, rig.of(SurveySettings)).tags), rate / speed
    )
