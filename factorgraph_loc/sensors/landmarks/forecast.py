"""Expected information and simulated sightings of landmarks along a path, for planning.

Repeated sightings from one pose are replaced by their mean with reduced noise. Landmarks out of sight add nothing.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.interfaces import Array32, Places
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings, SightingSettings
from factorgraph_loc.sensors.landmarks.simulation import in_sight
from factors.compiled import compiled
from factors.landmarks import model as bearing_range
from factors.landmarks.model import BearingRangeModel
from factors.se2 import Array


@dataclass(frozen=True, eq=False)
class LandmarkForecast:
    """A :class:`~factorgraph_loc.sensors.interfaces.Forecast` for landmarks, ``looks_per_metre``; ``settings`` tell which are
    visible."""

    world: World
    model: BearingRangeModel
    looks_per_metre: float = 4.0
    settings: SightingSettings = field(default_factory=SightingSettings)
    goals: Array = field(default_factory=lambda: np.empty((0, 2)))

    def information(self, poses: Array, ways: Array) -> Array:
        """Information of the visible landmarks."""
        points = self.world.positions()
        n, k = in_sight(self.model, self.world, poses, self.settings)
        by_pose, _, _ = bearing_range.jacobians(self.model, poses[n], points[k])
        ranges, _ = bearing_range.predict(self.model, poses[n], points[k])
        whitened = by_pose / bearing_range.sigmas(self.model, ranges)[:, :, None]
        out = np.zeros((len(poses), 3, 3))
        np.add.at(out, n, np.swapaxes(whitened, 1, 2) @ whitened)
        return np.asarray((self.looks_per_metre * ways)[:, None, None] * out)

    def add_log_weights(self, poses: Array, metres: float, stops: Places, seed: np.uint64, out: Array32) -> None:
        """Weigh particles by simulated sightings."""
        looks, scans = metres * self.looks_per_metre / len(poses), len(out)
        points = self.world.positions()
        for s in range(len(poses)):
            j, k = in_sight(self.model, self.world, poses[s, :scans], self.settings)
            looking = s < stops[j]
            j, k = j[looking], k[looking]
            if not len(j):
                continue
            ranges, bearings = bearing_range.predict(self.model, poses[s][:, None], points[None])
            sigmas = bearing_range.sigmas(self.model, ranges[j, k]) / math.sqrt(looks)
            normals = np.random.default_rng((int(seed), s)).standard_normal((scans, len(points), 2))
            noise = sigmas * normals[j, k]
            measured = np.column_stack((ranges[j, k] + noise[:, 0], bearings[j, k] + noise[:, 1]))
            _add(ranges, bearings, measured, sigmas, j, k, out)


def forecast(world: World, rig: Rig, speed: float, settings: Any = None) -> LandmarkForecast | None:
    """The forecast for a robot with ``speed`` [m/s], with the settings of a simulation; None without a landmark sensor or
    landmarks."""
    if rig.find(BearingRangeSettings) is None or not world.landmarks:
        return None
    sightings = SightingSettings() if settings is None else settings.sightings
    return LandmarkForecast(world, rig.of(BearingRangeSettings).model(), sightings.rate / speed, sightings)


@compiled
def _add(
    ranges: Array,
    bearings: Array,
    measured: Array,
    sigmas: Array,
    scans: NDArray[np.int64],
    landmarks: NDArray[np.int64],
    out: Array32,
) -> None:
    for n in range(len(scans)):
        j, k = scans[n], landmarks[n]
        for i in range(len(ranges)):
            along = (ranges[i, k] - measured[n, 0]) / sigmas[n, 0]
            turn = bearings[i, k] - measured[n, 1]
            turn -= 2.0 * np.pi * np.floor(turn / (2.0 * np.pi) + 0.5)
            across = turn / sigmas[n, 1]
            out[j, i] -= np.float32(0.5 * (along * along + across * across))
