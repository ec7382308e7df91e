"""Simulates ranges and bearings of visible landmarks, and predicts their information for planning.

For planning, repeated sightings from one pose are replaced by their mean with reduced noise. A landmark out of sight
has no effect.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.maps.free_space import crosses
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.interfaces import Array32, Places, Ride, Simulated
from factorgraph_loc.sensors.landmarks.measurement import (
    BearingRange,
    BearingRangeSettings,
    BearingRangeStream,
    SightingSettings,
    points_of,
)
from factors import se2
from factors.compiled import compiled
from factors.landmarks import model as bearing_range
from factors.landmarks.kernels import linearize_each
from factors.landmarks.model import BearingRangeModel
from factors.se2 import Array


def simulate(ride: Ride) -> Simulated:
    """Return the simulated landmark sightings of a drive. The result is empty if the world has no landmarks."""
    if not ride.world.landmarks:
        return Simulated()
    settings, times = ride.settings.sightings, ride.times(ride.settings.sightings.rate)
    sensor, poses = ride.rig.of(BearingRangeSettings), ride.truth.at(times)
    look = times, poses, settings, ride.rng("landmarks"), sensor.z
    return Simulated({"bearing_range": sighting_stream(sensor.model(), ride.world, *look)})


def looks(settings: Any) -> dict[str, float]:
    """Return {"landmarks": N}, where N is the maximum number of simulated sightings per second. ``settings``: settings
    of the simulation. Raises ValueError if the world has landmarks, but the rig has no landmark sensor."""
    if settings.world.landmarks and settings.rig.find(BearingRangeSettings) is None:
        raise ValueError("the world has landmarks, expected a rig with a section [bearing_range]")
    return {"landmarks": settings.sightings.rate * settings.world.landmarks}


def sighting_stream(
    model: BearingRangeModel,
    world: World,
    times: Array,
    poses: Array,
    settings: SightingSettings,
    rng: np.random.Generator,
    z: float = 0.0,
) -> BearingRangeStream:
    """Return simulated sightings of all visible landmarks at ``times`` (N,) [s] from robot ``poses`` (N, 3).
    ``settings``: maximum range, field of view, and fraction and excess of late (too long) ranges. ``z``: height of the
    sensor [m]. ``rng``: draws the noise."""
    points, names = points_of(world.landmarks.values(), z), list(world.landmarks)
    n, k = in_sight(model, world, poses, settings)
    ranges, bearings = bearing_range.predict(model, poses[n], points[k])
    sigma = bearing_range.sigmas(model, ranges)
    noise = sigma * rng.standard_normal((len(n), 2))
    # noise must not make a range negative
    ranges, bearings = np.maximum(ranges + noise[:, 0], 1e-3), se2.wrap(bearings + noise[:, 1])
    if settings.late:
        ranges += settings.late_by * (rng.random(len(n)) < settings.late)
    if not settings.bearings:
        bearings = np.full(len(n), np.nan)
    return BearingRangeStream(times[n], [names[i] for i in k.tolist()], ranges, bearings)


def in_sight(
    model: BearingRangeModel, world: World, poses: Array, settings: SightingSettings
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices (K,) of poses and the indices (K,) of landmarks for all K pairs with a visible landmark. A
    visible landmark is in range, in the field of view, and not behind a wall. ``poses`` (N, 3): poses of the robot."""
    points = world.positions()
    sensors = se2.compose(poses, np.array(model.mounting))
    local = se2.transform_to(sensors[:, None], points[None])
    distance = np.hypot(local[..., 0], local[..., 1])
    direction = np.arctan2(local[..., 1], local[..., 0])
    near = (distance <= settings.max_range) & (np.abs(direction) <= settings.field_of_view / 2.0)
    n, k = np.nonzero(near)
    visible = ~crosses(world, sensors[n, :2], points[k])
    return n[visible], k[visible]


@dataclass(frozen=True, eq=False)
class SimulatedSightings:
    """A simulated landmark sensor on a robot. It implements :class:`~factorgraph_loc.sensors.interfaces.LiveSensor`."""

    model: BearingRangeModel
    world: World
    settings: SightingSettings
    rng: np.random.Generator
    channel: str = "bearing_range"
    decides: bool = False

    @property
    def rate(self) -> float:
        """The number of measurements per second."""
        return self.settings.rate

    def measure(self, t: float, pose: Array) -> BearingRange:
        """Return a simulated measurement at the time ``t`` [s] from the robot's ``pose`` (3,)."""
        sightings = sighting_stream(self.model, self.world, np.array((t,)), pose[None], self.settings, self.rng)
        return BearingRange(t, tuple(sightings.landmark), sightings.range, sightings.bearing)


def on_robot(world: World, rig: Rig, settings: Any, rng: np.random.Generator) -> SimulatedSightings | None:
    """Return the simulated landmark sensor of a rig, or None if the rig lacks one or the world has no landmarks.
    ``settings``: settings of the simulation. ``rng``: draws the noise."""
    if rig.find(BearingRangeSettings) is None or not world.landmarks:
        return None
    return SimulatedSightings(rig.of(BearingRangeSettings).model(), world, settings.sightings, rng)


@dataclass(frozen=True, eq=False)
class LandmarkForecast:
    """Predicts the information of landmark sightings on candidate paths. It implements
    :class:`~factorgraph_loc.sensors.interfaces.Forecast`. ``looks_per_metre``: the number of measurements per metre of
    path. ``settings``: range and field of view."""

    world: World
    model: BearingRangeModel
    looks_per_metre: float = 4.0
    settings: SightingSettings = field(default_factory=SightingSettings)
    goals: Array = field(default_factory=lambda: np.empty((0, 2)))

    def information(self, poses: Array, ways: Array) -> Array:
        """Return the Fisher information (N, 3, 3) of visible landmarks on ``poses`` (N, 3). ``ways`` (N,): the length
        [m] of the path segment of each pose. The number of measurements is proportional to it."""
        points = self.world.positions()
        n, k = in_sight(self.model, self.world, poses, self.settings)
        pairs = poses[n], points[k], *bearing_range.predict(self.model, poses[n], points[k])
        whitened = linearize_each(self.model.packed, *pairs)[1][..., : bearing_range.POINT]
        out = np.zeros((len(poses), 3, 3))
        np.add.at(out, n, np.swapaxes(whitened, 1, 2) @ whitened)
        return np.asarray((self.looks_per_metre * ways)[:, None, None] * out)

    def add_log_weights(self, poses: Array, metres: float, stops: Places, seed: np.uint64, out: Array32) -> None:
        """Simulate sightings from the first J of M particles, and add their log-likelihoods for all particles to
        ``out`` (J, M). ``poses`` (S, M, 3): the particles at S points of a path of length ``metres`` [m]. Other
        arguments: see :meth:`~factorgraph_loc.sensors.interfaces.Forecast.add_log_weights`."""
        sightings, scans = metres * self.looks_per_metre / len(poses), len(out)
        points = self.world.positions()
        for s in range(len(poses)):
            j, k = in_sight(self.model, self.world, poses[s, :scans], self.settings)
            looking = s < stops[j]
            j, k = j[looking], k[looking]
            if not len(j):
                continue
            ranges, bearings = bearing_range.predict(self.model, poses[s][:, None], points[None])
            sigmas = bearing_range.sigmas(self.model, ranges[j, k]) / math.sqrt(sightings)
            normals = np.random.default_rng((int(seed), s)).standard_normal((scans, len(points), 2))
            noise = sigmas * normals[j, k]
            measured = np.column_stack((ranges[j, k] + noise[:, 0], bearings[j, k] + noise[:, 1]))
            _add(ranges, bearings, measured, sigmas, j, k, out)


def forecast(world: World, rig: Rig, speed: float, settings: Any) -> LandmarkForecast | None:
    """Return the forecast of landmark sightings of a robot that drives at ``speed`` [m/s]. Returns None without a
    landmark sensor or landmarks. ``settings``: settings of the simulation."""
    if rig.find(BearingRangeSettings) is None or not world.landmarks:
        return None
    sightings = settings.sightings
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
    """Add to ``out[j, i]`` the log-likelihood of particle i, given the sightings that were simulated from particle j.

    ``scans``, ``landmarks`` (K,): the particle j and the landmark of each sighting. ``measured``, ``sigmas`` (K, 2):
    simulated range and bearing, and their standard deviations. ``ranges``, ``bearings`` (M, L): the predictions for L
    landmarks from M particles.
    """
    for n in range(len(scans)):
        j, k = scans[n], landmarks[n]
        for i in range(len(ranges)):
            along = (ranges[i, k] - measured[n, 0]) / sigmas[n, 0]
            turn = bearings[i, k] - measured[n, 1]
            turn -= 2.0 * np.pi * np.floor(turn / (2.0 * np.pi) + 0.5)
            across = turn / sigmas[n, 1]
            out[j, i] -= np.float32(0.5 * (along * along + across * across))
