"""Compiled kernels of :mod:`factors.camera.point`."""

import math

import numpy as np

from factors.camera.kernels import NEAREST, Lens, pixel
from factors.compiled import compiled
from factors.robust import huber_weight
from factors.se2 import Array

BEHIND = 100.0  # residual of a point behind the camera, in standard deviations
# Jacobian by the pose, by roll and pitch, by the point, and by all parameters of the camera
TILT, POINT, CONSTANTS, WIDTH = 3, 5, 8, 16


@compiled(error_model="numpy")
def seen(
    k: Lens,
    position: Array,
    rotation: Array,
    poses: Array,
    tilts: Array,
    points: Array,
    measured: Array,
    sigma: float,
    robust: float,
) -> tuple[Array, Array, Array]:
    """Of N points (N, 3), each seen from a pose (N, 3) by a robot with a tilt (N, 2): whitened, robustly weighted residuals (N, 2),
    their Jacobian (N, 2, WIDTH), and the squared residuals (N,) without weight.

    ``measured`` (N, 2): pixels. ``sigma``: standard deviation of each of their coordinates.
    """
    n = len(measured)
    residual, jacobian, squared = np.empty((n, 2)), np.empty((n, 2, WIDTH)), np.zeros(n)
    for i in range(n):
        at = poses[i], tilts[i], points[i], measured[i]
        squared[i] = see((k, position, rotation), at, sigma, robust, residual[i], jacobian[i])
    return residual, jacobian, squared


@compiled(error_model="numpy")
def turned(roll: float, pitch: float) -> Array:
    """The rotation (3, 3) of a robot with this tilt."""
    angle = math.sqrt(roll * roll + pitch * pitch)
    a, b = (math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)) if angle > 1e-6 else (1.0, 0.5)
    turn = np.empty((3, 3))
    turn[0, 0], turn[1, 1], turn[2, 2] = 1.0 - b * pitch * pitch, 1.0 - b * roll * roll, 1.0 - b * angle * angle
    turn[0, 1] = turn[1, 0] = b * roll * pitch
    turn[0, 2], turn[2, 0], turn[1, 2], turn[2, 1] = a * pitch, -a * pitch, -a * roll, a * roll
    return turn


@compiled(error_model="numpy")
def see(
    camera: tuple[Lens, Array, Array],
    at: tuple[Array, Array, Array, Array],
    sigma: float,
    robust: float,
    residual: Array,
    jacobian: Array,
) -> float:
    """One of :func:`seen`: the squared residual; ``residual`` and ``jacobian`` in place. ``at``: pose, tilt, point and pixel."""
    (k, position, rotation), (pose, tilt, point, measured) = camera, at
    turn, c, s = turned(tilt[0], tilt[1]), math.cos(pose[2]), math.sin(pose[2])
    dx, dy, z = point[0] - pose[0], point[1] - pose[1], point[2]
    x, y = c * dx + s * dy, c * dy - s * dx
    # in the robot's frame, and from the camera along the robot's axes
    bx = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z
    by = turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z
    bz = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z
    ax, ay, az = bx - position[0], by - position[1], bz - position[2]
    depth = rotation[0, 2] * ax + rotation[1, 2] * ay + rotation[2, 2] * az
    u, v, by_u, by_v = pixel(
        k,
        rotation[0, 0] * ax + rotation[1, 0] * ay + rotation[2, 0] * az,
        rotation[0, 1] * ax + rotation[1, 1] * ay + rotation[2, 1] * az,
        depth,
    )
    residual[0], residual[1] = (u - measured[0]) / sigma, (v - measured[1]) / sigma
    squared: float = residual[0] * residual[0] + residual[1] * residual[1]
    scale = math.sqrt(huber_weight(squared, robust)) / sigma
    if depth < NEAREST:
        squared, scale = 2.0 * BEHIND * BEHIND, 0.0
        residual[0] = residual[1] = BEHIND
    weight = math.sqrt(huber_weight(squared, robust))
    residual[0], residual[1] = weight * residual[0], weight * residual[1]
    for r in range(2):
        d = by_u if r == 0 else by_v
        g0 = scale * (rotation[0, 0] * d[0] + rotation[0, 1] * d[1] + rotation[0, 2] * d[2])
        g1 = scale * (rotation[1, 0] * d[0] + rotation[1, 1] * d[1] + rotation[1, 2] * d[2])
        g2 = scale * (rotation[2, 0] * d[0] + rotation[2, 1] * d[1] + rotation[2, 2] * d[2])
        e0 = turn[0, 0] * g0 + turn[0, 1] * g1 + turn[0, 2] * g2
        e1 = turn[1, 0] * g0 + turn[1, 1] * g1 + turn[1, 2] * g2
        e2 = turn[2, 0] * g0 + turn[2, 1] * g1 + turn[2, 2] * g2
        jacobian[r, 0], jacobian[r, 1], jacobian[r, 2] = -e0, -e1, e0 * y - e1 * x
        # a change of the tilt turns the robot about other axes than its own by half of the tilt
        about = 0.5 * (g0 * by - g1 * bx)
        jacobian[r, TILT] = g1 * bz - g2 * by + about * tilt[1]
        jacobian[r, TILT + 1] = g2 * bx - g0 * bz - about * tilt[0]
        jacobian[r, POINT], jacobian[r, POINT + 1], jacobian[r, POINT + 2] = c * e0 - s * e1, s * e0 + c * e1, e2
        jacobian[r, CONSTANTS], jacobian[r, CONSTANTS + 1], jacobian[r, CONSTANTS + 2] = -g0, -g1, -g2
        jacobian[r, CONSTANTS + 3] = g1 * az - g2 * ay
        jacobian[r, CONSTANTS + 4] = g2 * ax - g0 * az
        jacobian[r, CONSTANTS + 5] = g0 * ay - g1 * ax
        # a longer focal length
        jacobian[r, CONSTANTS + 6] = scale * (u - k[2] if r == 0 else v - k[3])
        jacobian[r, CONSTANTS + 7] = 0.0
    return squared
