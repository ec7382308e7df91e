"""Inverse-depth parametrization of points.

Source: Civera, Davison, Montiel, "Inverse depth parametrization for monocular SLAM", IEEE Transactions on Robotics
24(5), 2008, sections III (parametrization and measurement), IV (initialization) and VI (conversion to x, y, z).

A ray (6,) represents a point by six values: the camera's position (x, y, z) [m] at the first sighting, azimuth and
elevation [rad] of the direction in the world, and the inverse depth [1/m]. The world's z axis is up, so azimuth and
elevation are singular only for points straight above or below.

A Gaussian of the inverse depth represents all depths from a minimum to infinity. A point is therefore a useful landmark
from its first sighting on: it first informs the camera's rotation, and the translation as soon as there is parallax.
"""

import numpy as np

from factors.camera.model import CameraModel, linearize_in_space, rays
from factors.se2 import Array

SIZE = 6  # number of values of a ray
LEAST_FLAT = 1e-6  # minimum horizontal part of a direction, because a vertical direction has no azimuth
LINEAR = 0.1  # below this index of :func:`linearity`, x, y, z of a point are nearly Gaussian (section VI)


def directions(rays: Array) -> tuple[Array, Array]:
    """Return the directions of K rays as unit vectors (K, 3) in the world, and their Jacobian (K, 3, 2) by azimuth and
    elevation. ``rays`` (K, 6): x, y, z of the ray's start, azimuth, elevation, and inverse depth."""
    azimuth, elevation = rays[:, 3], rays[:, 4]
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    by_angles = np.zeros((len(rays), 3, 2))
    by_angles[:, 0, 0], by_angles[:, 1, 0] = -ce * sa, ce * ca
    by_angles[:, 0, 1], by_angles[:, 1, 1], by_angles[:, 2, 1] = -se * ca, -se * sa, ce
    return np.column_stack((ce * ca, ce * sa, se)), by_angles


def turned(angles: Array) -> Array:
    """Return the derivative (2, 3) of a direction's azimuth and elevation by a small rotation vector about the world's
    axes. ``angles`` (2,): azimuth and elevation [rad] of the direction."""
    azimuth, elevation = angles.tolist()
    c, s = np.cos(azimuth), np.sin(azimuth)
    slope = np.tan(elevation)
    return np.array(((-c * slope, -s * slope, 1.0), (s, -c, 0.0)))


def positions(rays: Array) -> tuple[Array, Array]:
    """Return the world positions (K, 3) of points, and their Jacobian (K, 3, 6) by the rays. ``rays`` (K, 6): x, y, z
    of the ray's start, azimuth, elevation, and inverse depth of each point. Inverse depths must be positive."""
    ahead, by_angles = directions(rays)
    inverse = rays[:, 5]
    jacobian = np.zeros((len(rays), 3, SIZE))
    jacobian[:, :, :3] = np.eye(3)
    jacobian[:, :, 3:5] = by_angles / inverse[:, None, None]
    jacobian[:, :, 5] = -ahead / inverse[:, None] ** 2
    return rays[:, :3] + ahead / inverse[:, None], jacobian


def linearize(model: CameraModel, position: Array, rotation: Array, rays: Array) -> tuple[Array, Array, Array]:
    """Predict the pixels of K points in a camera at ``position`` (3,) with ``rotation`` (3, 3) in the world. The points
    are given as ``rays`` (K, 6): x, y, z of the ray's start, azimuth, elevation, inverse depth.

    Returns the pixels (K, 2) and their Jacobians by the camera's perturbation (K, 2, 6) and by the rays (K, 2, 6). The
    perturbation is in the camera frame, with rotation before translation. A pixel depends only on the direction from
    the camera to the point, so the inverse depth may be zero.
    """
    ahead, by_angles = directions(rays)
    inverse = rays[:, 5, None]
    away = rays[:, :3] - position
    # the vector from the camera to the point, times the inverse depth
    direction = inverse * away + ahead
    pixels, by_camera, by_direction = linearize_in_space(model, np.zeros(3), rotation, direction)
    by_camera[..., 3:] = -inverse[:, None] * (by_direction @ rotation)
    by_rays = np.empty((len(rays), 2, SIZE))
    by_rays[..., :3] = inverse[:, None] * by_direction
    by_rays[..., 3:5] = by_direction @ by_angles
    by_rays[..., 5] = np.einsum("kij,kj->ki", by_direction, away)
    return pixels, by_camera, by_rays


def begin(
    model: CameraModel, position: Array, rotation: Array, pixel: Array, inverse_depth: float
) -> tuple[Array, Array, Array]:
    """Return the ray of a new point from its first ``pixel`` (2,) and an assumed ``inverse_depth`` [1/m].

    ``position`` (3,), ``rotation`` (3, 3): the camera's pose in the world. Returns the ray (6,): camera position,
    azimuth, elevation, inverse depth. Also returns its Jacobians by the perturbation (6, 6) of the camera's pose, and
    by pixel and inverse depth (6, 3). The perturbation is in the camera frame, with rotation before translation.
    """
    (local,) = rays(model, pixel[None])
    _, _, by_local = linearize_in_space(model, np.zeros(3), np.eye(3), local[None])
    ahead = rotation @ local
    x, y, z = ahead.tolist()
    across = max(float(np.hypot(x, y)), LEAST_FLAT)
    square = across**2 + z**2
    by_ahead = np.array(
        (
            (-y / across**2, x / across**2, 0.0),
            (-x * z / (across * square), -y * z / (across * square), across / square),
        )
    )
    by_camera, by_seen = np.zeros((SIZE, 6)), np.zeros((SIZE, 3))
    by_camera[:3, 3:] = rotation
    lx, ly, lz = local.tolist()
    by_camera[3:5, :3] = by_ahead @ rotation @ np.array(((0.0, lz, -ly), (-lz, 0.0, lx), (ly, -lx, 0.0)))
    by_seen[3:5, :2] = by_ahead @ rotation[:, :2] @ np.linalg.inv(by_local[0, :, :2])
    by_seen[5, 2] = 1.0
    ray = np.array((*position.tolist(), np.arctan2(y, x), np.arctan2(z, across), inverse_depth))
    return ray, by_camera, by_seen


def linearity(rays: Array, sigmas: Array, position: Array) -> Array:
    """Return the linearity index (K,) of Civera et al. (section VI). It is small if x, y, z of a point are nearly
    Gaussian.

    ``rays`` (K, 6): x, y, z of the ray's start, azimuth, elevation, and inverse depth of each point. ``sigmas`` (K,):
    standard deviations of the inverse depths. ``position`` (3,): the camera's position in the world. If the index is
    below :data:`LINEAR`, x, y, z can replace the ray. It is infinite if the inverse depth is not positive.
    """
    inverse = rays[:, 5]
    index = np.full(len(rays), np.inf)
    near = inverse > 0.0
    if near.any():
        points, _ = positions(rays[near])
        ahead, _ = directions(rays[near])
        away = points - position
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        cosine = np.abs(np.einsum("ki,ki->k", ahead, away)) / distance
        index[near] = 4.0 * sigmas[near] / inverse[near] ** 2 / distance * cosine
    return index
