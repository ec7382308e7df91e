"""Simulates the pixels of visible named points by the camera model, without rendering images."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from factorgraph_loc.maps.free_space import crosses, nearest_walls
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.measurement import SightingStream
from factorgraph_loc.sensors.camera.settings import CameraSettings, PixelSettings
from factorgraph_loc.sensors.interfaces import Ride, Simulated
from factors.camera import model as reprojection
from factors.camera.model import CameraModel
from factors.se2 import Array

NEAR, FAR = 0.3, 10.0  # m; a point is detected if its depth is within these bounds
OBLIQUE = math.radians(75.0)  # a point is detected if the angle between line of sight and surface normal is below this


def simulate(ride: Ride) -> Simulated:
    """Return the simulated detections of named points on a drive. The result is empty if the world has no points."""
    if ride.world.points is None:
        return Simulated()
    settings, camera = ride.settings.pixels, ride.rig.of(CameraSettings)
    times = ride.times(settings.rate)
    detected = pixel_stream(camera.model(), ride.world, times, ride.truth.at(times), settings, ride.rng("points"))
    return Simulated({"sightings": replace(detected, t=detected.t - camera.time_offset)})


def looks(settings: Any) -> dict[str, float]:
    """Return {"points": N}, where N is the maximum number of simulated detections per second. ``settings``: settings of
    the simulation. Raises ValueError if the world has points, but the rig has no camera."""
    if settings.world.points and settings.rig.find(CameraSettings) is None:
        raise ValueError("the world has points, expected a rig with a camera")
    return {"points": settings.pixels.rate * settings.world.points}


def pixel_stream(
    model: CameraModel, world: World, times: Array, poses: Array, settings: PixelSettings, rng: np.random.Generator
) -> SightingStream:
    """Return simulated detections of points in images taken at ``times`` (N,) [s] from robot ``poses`` (N, 3).

    A point is detected if it is inside the image, within range, not occluded, and not viewed too obliquely. Walls and
    furniture occlude points at any height. ``settings``: maximum number of points per image, and fraction of outliers.
    ``rng``: draws noise and outliers.
    """
    points = world.points
    assert points is not None, "the world has points"
    positions, normals = points.positions, surface_normals(world, points.positions[:, :2])
    cameras = np.array([reprojection.camera_pose(model, pose)[0] for pose in poses]).reshape(-1, 3)
    rows, columns, pixels = [], [], []
    for i, pose in enumerate(poses):
        uv, depth = reprojection.predict(model, pose, positions)
        rays = cameras[i] - positions
        front = (rays[:, :2] * normals).sum(axis=1) >= math.cos(OBLIQUE) * np.linalg.norm(rays, axis=1)
        k = np.flatnonzero(front & (depth >= NEAR) & (depth <= FAR) & model.contains(uv))
        rows.append(np.full(len(k), i))
        columns.append(k)
        pixels.append(uv[k])
    n, k, uv = np.concatenate(rows), np.concatenate(columns), np.concatenate(pixels)
    visible = ~crosses(world, cameras[n, :2], positions[k, :2])
    n, k, uv = n[visible], k[visible], uv[visible]
    chosen = _at_most(settings.max_points, n, rng)
    n, k = n[chosen], k[chosen]
    uv = uv[chosen] + model.sigma * rng.standard_normal((len(n), 2))
    wrong = rng.random(len(n)) < settings.wrong
    outliers = rng.uniform((-0.5, -0.5), (model.width - 0.5, model.height - 0.5), (len(n), 2))
    uv = np.where(wrong[:, None], outliers, uv)
    return SightingStream(times[n], [points.names[j] for j in k.tolist()], uv[:, 0], uv[:, 1])


def surface_normals(world: World, places: Array) -> Array:
    """Return the unit normals (K, 2) of the walls nearest to ``places`` (K, 2) [m]. A normal points to the side of the
    wall with this position. Returns zeros if the world has no walls."""
    if not world.walls:
        return np.zeros((len(places), 2))
    walls = np.array(world.walls, dtype=float).reshape(-1, 2, 2)[nearest_walls(world, places)[1]]
    along = walls[:, 1] - walls[:, 0]
    normals = np.column_stack((-along[:, 1], along[:, 0])) / np.maximum(np.hypot(*along.T), 1e-12)[:, None]
    behind = np.sum((places - walls[:, 0]) * normals, axis=1) < 0.0
    return np.asarray(np.where(behind[:, None], -normals, normals))


def _at_most(count: int, frames: Array, rng: np.random.Generator) -> Array:
    """Return the sorted indices of at most ``count`` rows of each image, selected at random. ``frames`` (K,): the image
    number of each row, sorted."""
    shuffled = np.lexsort((rng.random(len(frames)), frames))
    starts = np.searchsorted(frames, frames)
    return np.sort(shuffled[np.arange(len(frames)) - starts < count])
