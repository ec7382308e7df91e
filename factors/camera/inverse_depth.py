"""Inverse-depth parametrization of points.

Civera, Davison, Montiel, "Inverse depth parametrization for monocular SLAM", IEEE Transactions on Robotics 24(5), 2008, sections
III (parametrization and measurement), IV (initialization) and VI (conversion to x, y, z). Six values: the camera's position
(x, y, z) [m] at the first sighting, azimuth and elevation [rad] of the ray in the world, and the inverse depth [1/m]. The world's
z axis is up here, so the direction is singular only for points straight above or below.

A Gaussian of the inverse depth represents all depths from a minimum to infinity, so the first sighting of a point already informs
the camera's rotation. It informs the translation as soon as there is parallax.
"""

import numpy as np

from factors.camera.model import CameraModel, linearize_in_space, rays
from factors.se2 import Array

SIZE = 6  # values of a point
LEAST_FLAT = 1e-6  # minimum horizontal part of a direction; vertical directions have no azimuth
LINEAR = 0.1  # linearity index below which x, y, z are nearly Gaussian (section VI)


def directions(rays: Array) -> tuple[Array, Array]:
    """Unit vectors (K, 3) of ``rays`` (K, 6) in the world, and their Jacobian (K, 3, 2) by azimuth and elevation."""
    azimuth, elevation = rays[:, 3], rays[:, 4]
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    by_angles = np.zeros((len(rays), 3, 2))
    by_angles[:, 0, 0], by_angles[:, 1, 0] = -ce * sa, ce * ca
    by_angles[:, 0, 1], by_angles[:, 1, 1], by_angles[:, 2, 1] = -se * ca, -se * sa, ce
    return np.column_stack((ce * ca, ce * sa, se)), by_angles


def turned(angles: Array) -> Array:
    """The derivative (2, 3) of azimuth and elevation, ``angles`` (2,), by a rotation of the world."""
    azimuth, elevation = angles.tolist()
    c, s = np.cos(azimuth), np.sin(azimuth)
    slope = np.tan(elevation)
    return np.array(((-c * slope, -s * slope, 1.0), (s, -c, 0.0)))


def positions(rays: Array) -> tuple[Array, Array]:
    """Positions (K, 3) of ``rays`` (K, 6) with positive inverse depths, and their Jacobian (K, 3, 6)."""
    ahead, by_angles = directions(rays)
    inverse = rays[:, 5]
    jacobian = np.zeros((len(rays), 3, SIZE))
    jacobian[:, :, :3] = np.eye(3)
    jacobian[:, :, 3:5] = by_angles / inverse[:, None, None]
    jacobian[:, :, 5] = -ahead / inverse[:, None] ** 2
    return rays[:, :3] + ahead / inverse[:, None], jacobian


def linearize(model: CameraModel, position: Array, rotation: Array, rays: Array) -> tuple[Array, Array, Array]:
    """Pixels (K, 2) of ``rays`` (K, 6) in a camera at ``position`` (3,) with ``rotation`` (3, 3) in the world; their Jacobians by
    the camera's perturbation (K, 2, 6), as in :func:`~factors.camera.model.linearize_in_space`, and by the rays (K, 2, 6).

    A pixel depends on the direction only, so the inverse depth may be zero (section III).
    """
    ahead, by_angles = directions(rays)
    inverse = rays[:, 5, None]
    away = rays[:, :3] - position
    # the vector to the point, times its inverse depth
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
    """Initialize a ray (6,) from its first ``pixel`` (2,), in a camera as in :func:`linearize`. Returns also its Jacobians by the
    camera's perturbation (6, 6), and by the pixel and the inverse depth (6, 3) (section IV)."""
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
    """The linearity index (K,) of ``rays`` (K, 6) with standard deviations ``sigmas`` (K,) of their inverse depths, seen from
    ``position`` (3,), infinite for inverse depths that are not positive. Below :data:`LINEAR`, x, y, z are nearly Gaussian
    (section VI)."""
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
