"""Range and bearing of landmarks in sight, drawn from the model of a rig."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.log import BearingRangeStream
from factorgraph_loc.simulation.settings import SightingSettings
from factorgraph_loc.world import World
from factors import bearing_range, se2
from factors.bearing_range import BearingRangeModel
from factors.se2 import Array


def sighting_stream(
    model: BearingRangeModel,
    world: World,
    times: Array,
    poses: Array,
    settings: SightingSettings,
    rng: np.random.Generator,
) -> BearingRangeStream:
    """What the sensor reports at ``times`` (N,) from ``poses`` (N, 3): the landmarks in range, in view and not behind a wall."""
    points, names = world.positions(), list(world.landmarks)
    n, k = in_sight(model, world, poses, settings)
    ranges, bearings = bearing_range.predict(model, poses[n], points[k])
    sigma = bearing_range.sigmas(model, ranges)
    noise = sigma * rng.standard_normal((len(n), 2))
    # a range is above zero whatever the noise
    ranges = np.maximum(ranges + noise[:, 0], 1e-3)
    return BearingRangeStream(times[n], [names[i] for i in k.tolist()], ranges, se2.wrap(bearings + noise[:, 1]))


def in_sight(
    model: BearingRangeModel, world: World, poses: Array, settings: SightingSettings
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Which of ``poses`` (N, 3) see which landmarks: places (K,) in both."""
    points = world.positions()
    sensors = se2.compose(poses, np.array(model.mounting))
    local = se2.transform_to(sensors[:, None], points[None])
    distance = np.hypot(local[..., 0], local[..., 1])
    direction = np.arctan2(local[..., 1], local[..., 0])
    near = (distance <= settings.max_range) & (np.abs(direction) <= settings.field_of_view / 2.0)
    n, k = np.nonzero(near)
    visible = ~crosses(world, sensors[n, :2], points[k])
    return n[visible], k[visible]


def crosses(world: World, a: Array, b: Array) -> NDArray[np.bool_]:
    """Whether the segments from ``a`` (N, 2) to ``b`` (N, 2) cross a wall of the world."""
    out = np.zeros(len(a), dtype=bool)
    d = b - a
    for x1, y1, x2, y2 in world.walls:
        wall = np.array((x2 - x1, y2 - y1))
        start = np.array((x1, y1))
        side_a, side_b = _cross(wall, a - start), _cross(wall, b - start)
        side_1, side_2 = _cross(d, start - a), _cross(d, start + wall - a)
        out |= (side_a * side_b < 0.0) & (side_1 * side_2 <= 0.0)
    return out


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
