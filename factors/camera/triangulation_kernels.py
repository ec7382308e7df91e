"""Compiled triangulation of points from several camera poses."""

import math

import numpy as np

from factors.camera.kernels import Lens, pixel
from factors.compiled import compiled
from factors.gaussian import inverse, product, product_by_transpose, solved
from factors.se2 import Array

MIN_PARALLAX = 0.03  # rad; smallest angle between the outermost rays of a point
NEAREST = 0.3  # m; smallest depth of a triangulated point
ITERATIONS, SETTLED = 4, 1e-3  # maximum number of steps, and the step [m] below which the solution has converged


@compiled(error_model="numpy")
def triangulated(
    k: Lens,
    centres: Array,
    turns: Array,
    rays: Array,
    pixels: Array,
    sigmas: Array,
    largest_sigma: float,
    parallax: float,
    nearest: float,
    robust: float,
) -> tuple[bool, Array, Array, Array]:
    """Triangulate one point from M poses of a camera with the lens ``k``.

    ``centres`` (M, 3), ``turns`` (M, 3, 3): positions and rotations of the cameras in the world.
    ``rays`` (M, 3): unit vectors to the point in each camera frame.
    ``pixels`` (M, 2), ``sigmas`` (M,): the measured pixels, and the standard deviation of each coordinate.
    ``largest_sigma``: the largest allowed standard deviation of the point, relative to its smallest depth. ``parallax``
    [rad]: the smallest allowed angle between the outermost rays. ``nearest`` [m]: the smallest allowed depth.
    ``robust``: the scale of Huber's loss in standard deviations, infinite for least squares.

    Returns True if the parallax is large enough and the point certain enough. Also returns the point (3,) in the world,
    its covariance (3, 3), and the squared norms (M,) of its whitened residuals. The norms are infinite if the point is
    not at least ``nearest`` in front of all cameras.

    The initial estimate is the point nearest to all rays. Gauss-Newton steps then reduce the reprojection error
    (Hartley and Zisserman, "Multiple View Geometry", 2004, chapter 12).
    """
    directions = np.empty_like(rays)
    for m in range(len(rays)):
        direction = product(turns[m], rays[m].reshape(3, 1))
        directions[m, 0], directions[m, 1], directions[m, 2] = direction[0, 0], direction[1, 0], direction[2, 0]
    covariance, squared = np.zeros((3, 3)), np.full(len(rays), np.inf)
    point = np.zeros(3)
    if product_by_transpose(directions, directions).min() > math.cos(parallax):
        return False, point, covariance, squared
    point = _nearest(centres, directions)
    for iteration in range(ITERATIONS + 1):
        information, pull, depth = _inform(k, centres, turns, pixels, sigmas, point, robust, squared)
        if not depth > nearest:
            squared[:] = np.inf
            return True, point, covariance, squared
        covariance = inverse(information)
        # the limit is twice as large here, because the covariance of the initial point is less accurate
        if not _is_below(covariance, ((2.0 if iteration == 0 else 1.0) * largest_sigma * depth) ** 2):
            return False, point, covariance, squared
        if iteration < ITERATIONS:
            step = product(covariance, pull).reshape(3)
            point += step
            if np.abs(step).max() < SETTLED:
                break
    return True, point, covariance, squared


@compiled(error_model="numpy")
def inverse_depths(first: Array, second: Array, position: Array, motion: Array) -> Array:
    """Return the inverse depths (K,) [1/m] of K points in the first of two images. A point is assumed where the first
    ray is nearest to the second ray.

    ``first``, ``second`` (K, 3): the viewing rays in each image, vectors along the robot's axes with depth 1 in the
    camera. ``position`` (3,): position of the camera in the robot frame. ``motion`` (3,): the robot's pose at the
    second image in the frame of its pose at the first image.

    An inverse depth is negative for a point behind the camera.
    """
    inverse_depth = np.empty(len(first))
    c, s = math.cos(motion[2]), math.sin(motion[2])
    x = motion[0] + c * position[0] - s * position[1] - position[0]
    y = motion[1] + s * position[0] + c * position[1] - position[1]
    for k in range(len(first)):
        a, b = first[k], second[k]
        u, v, w = c * b[0] - s * b[1], s * b[0] + c * b[1], b[2]  # the second ray in the first frame
        # the cross product of the equation a / inverse_depth = (x, y, 0) + mu (u, v, w) with (u, v, w) eliminates mu
        far_x, far_y, far_z = y * w, -x * w, x * v - y * u
        squared = max(far_x * far_x + far_y * far_y + far_z * far_z, 1e-18)
        across = (a[1] * w - a[2] * v) * far_x + (a[2] * u - a[0] * w) * far_y + (a[0] * v - a[1] * u) * far_z
        inverse_depth[k] = across / squared
    return inverse_depth


@compiled(error_model="numpy")
def _nearest(centres: Array, directions: Array) -> Array:
    """Return the point (3,) with the least sum of squared distances from M rays. ``centres`` (M, 3): starts of the
    rays. ``directions`` (M, 3): their unit vectors."""
    left, right = np.zeros((3, 3)), np.zeros((3, 1))
    for m in range(len(directions)):
        for i in range(3):
            for j in range(3):
                across = (1.0 if i == j else 0.0) - directions[m, i] * directions[m, j]
                left[i, j] += across
                right[i, 0] += across * centres[m, j]
    return solved(left, right)[0].reshape(3)


@compiled(error_model="numpy")
def _inform(
    k: Lens, centres: Array, turns: Array, pixels: Array, sigmas: Array, point: Array, robust: float, squared: Array
) -> tuple[Array, Array, float]:
    """Return the Gauss-Newton system of a ``point`` (3,) in M images: its information matrix (3, 3), the negative
    gradient (3, 1) of the loss, and the smallest depth. The remaining arguments are those of :func:`triangulated`.
    Writes the squared norms of the whitened residuals into ``squared`` (M,)."""
    information, pull, depth, row, error = np.zeros((3, 3)), np.zeros((3, 1)), np.inf, np.empty(3), np.empty(2)
    for m in range(len(centres)):
        local = product((point - centres[m]).reshape(1, 3), turns[m])
        depth = min(depth, local[0, 2])
        u, v, by_u, by_v = pixel(k, local[0, 0], local[0, 1], local[0, 2])
        error[0], error[1] = u - pixels[m, 0], v - pixels[m, 1]
        error[0] /= sigmas[m]
        error[1] /= sigmas[m]
        squared[m] = error[0] ** 2 + error[1] ** 2
        weight = 1.0 if squared[m] <= robust**2 else robust / math.sqrt(squared[m])
        for r in range(2):
            d = by_u if r == 0 else by_v
            for j in range(3):
                row[j] = (turns[m, j, 0] * d[0] + turns[m, j, 1] * d[1] + turns[m, j, 2] * d[2]) / sigmas[m]
            for i in range(3):
                pull[i, 0] -= weight * row[i] * error[r]
                for j in range(3):
                    information[i, j] += weight * row[i] * row[j]
    return information, pull, depth


@compiled(error_model="numpy")
def _is_below(covariance: Array, most: float) -> bool:
    """True if the largest eigenvalue of a covariance (3, 3) is less than ``most``."""
    a, b, c = most - covariance[0, 0], most - covariance[1, 1], most - covariance[2, 2]
    d, e, f = covariance[0, 1], covariance[0, 2], covariance[1, 2]
    two = a * b - d * d
    return bool(a > 0.0 and two > 0.0 and c * two - a * f * f - b * e * e - 2.0 * d * e * f > 0.0)
