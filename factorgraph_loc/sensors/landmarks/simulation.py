"""Simulated range and bearing of visible landmarks, from the model of a rig."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.maps.free_space import crosses
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.interfaces import Ride, Simulated
from factorgraph_loc.sensors.landmarks.measurement import BearingRange, BearingRangeStream
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings, SightingSettings
from factors import se2
from factors.landmarks import model as bearing_range
from factors.landmarks.model import BearingRangeModel
from factors.se2 import Array


def simulate(ride: Ride) -> Simulated:
    """The sightings of a simulated drive through a world with landmarks."""
    if not ride.world.landmarks:
        return Simulated()
    settings, times = ride.settings.sightings, ride.times(ride.settings.sightings.rate)
    model, poses = ride.rig.of(BearingRangeSettings).model(), ride.truth.at(times)
    return Simulated(
        {"bearing_range": sighting_stream(model, ride.world, times, poses, settings, ride.rng("landmarks"))}
    )


def looks(settings: Any) -> dict[str, float]:
    """Rate [Hz] of the simulated sightings; ValueError without a landmark sensor."""
    if settings.world.landmarks and settings.rig.find(BearingRangeSettings) is None:
        raise ValueError("the world has landmarks, expected a rig with bearing_range")
    return {"landmarks": settings.sightings.rate * settings.world.landmarks}


def sighting_stream(
    model: BearingRangeModel,
    world: World,
    times: Array,
    poses: Array,
    settings: SightingSettings,
    rng: np.random.Generator,
) -> BearingRangeStream:
    """Sightings at ``times`` (N,) from ``poses`` (N, 3): the landmarks in range, in the field of view and not behind a wall."""
    points, names = world.positions(), list(world.landmarks)
    n, k = in_sight(model, world, poses, settings)
    ranges, bearings = bearing_range.predict(model, poses[n], points[k])
    sigma = bearing_range.sigmas(model, ranges)
    noise = sigma * rng.standard_normal((len(n), 2))
    # a range is positive whatever the noise
    ranges = np.maximum(ranges + noise[:, 0], 1e-3)
    return BearingRangeStream(times[n], [names[i] for i in k.tolist()], ranges, se2.wrap(bearings + noise[:, 1]))


def in_sight(
    model: BearingRangeModel, world: World, poses: Array, settings: SightingSettings
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Visible pairs of ``poses`` (N, 3) and landmarks: indices (K,) of both."""
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
    """A :class:`~factorgraph_loc.sensors.interfaces.LiveSensor` of landmarks."""

    model: BearingRangeModel
    world: World
    settings: SightingSettings
    rng: np.random.Generator
    channel: str = "bearing_range"
    decides: bool = False

    @property
    def rate(self) -> float:
        """Measurement rate [Hz]."""
        return self.settings.rate

    def measure(self, t: float, pose: Array) -> BearingRange:
        """The sightings at ``t``."""
        seen = sighting_stream(self.model, self.world, np.array((t,)), pose[None], self.settings, self.rng)
        return BearingRange(t, tuple(seen.landmark), seen.range, seen.bearing)


def on_robot(world: World, rig: Rig, settings: Any, rng: np.random.Generator) -> SimulatedSightings | None:
    """The sensor of a rig, or None if the rig lacks it or the world has no landmarks."""
    if rig.find(BearingRangeSettings) is None or not world.landmarks:
        return None
    return SimulatedSightings(rig.of(BearingRangeSettings).model(), world, settings.sightings, rng)
