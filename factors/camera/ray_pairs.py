"""Matches between two images of a robot that moves on a plane: their epipolar errors and the depths of their points.

A match is a pair of rays that should intersect: with the camera's translation tau from the first image to the second, and the
rotation R between them, the epipolar constraint is ``a . (tau x R b) = 0`` (Longuet-Higgins, Nature 293, 1981). Its first-order
geometric error is Sampson's: the constraint divided by its standard deviation from the noise of both pixels (Hartley and Zisserman,
"Multiple View Geometry in Computer Vision", 2nd edition, 2004, eq. 11.9), here with the pixel noise propagated through the lens.
The length of tau is unobservable, so matches determine two of the three numbers of a planar motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from factors.camera.model import CameraModel, linearize_in_space, rays
from factors.compiled import compiled
from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class RayPairs:
    """K matches: rays ``first`` and ``second`` (K, 3) in the robot frame at the time of each image, of depth 1 along the camera's
    ``axis`` (3,); their derivatives (K, 3, 2) by the pixel noise in standard deviations; and the camera's ``position`` (3,) [m]
    on the robot."""

    first: Array
    second: Array
    first_noise: Array
    second_noise: Array
    position: Array
    axis: Array

    @classmethod
    def of(cls, model: CameraModel, first: Array, second: Array) -> RayPairs:
        """From pixels (K, 2) in both images."""
        a, first_noise = _rays(model, np.asarray(first, dtype=float))
        b, second_noise = _rays(model, np.asarray(second, dtype=float))
        return cls(a, b, first_noise, second_noise, np.asarray(model.position, dtype=float), model.rotation[:, 2])

    def __len__(self) -> int:
        return len(self.first)


def sampson(pairs: RayPairs, motion: Array) -> tuple[Array, Array, Array]:
    """Whitened errors (K,) of the matches for the robot's ``motion`` (3,) from the first image to the second, their Jacobian (K, 3)
    by its body-frame perturbation, and the whitened Jacobian (K, 3) of the constraint at the nearest intersecting rays. Zero if
    the camera does not move.

    The first Jacobian gives the gradient of the cost. The information must be computed from the second one, because near the
    epipole the standard deviation vanishes, and the first one includes the noise divided by it.
    """
    residual, jacobian, signal = np.empty(len(pairs)), np.empty((len(pairs), 3)), np.empty((len(pairs), 3))
    arguments = (pairs.first, pairs.second, pairs.first_noise, pairs.second_noise, pairs.position)
    _sampson(*arguments, float(motion[0]), float(motion[1]), float(motion[2]), residual, jacobian, signal)
    return residual, jacobian, signal


def translation(position: Array, motion: Array) -> Array:
    """The translation (2,) [m] of the camera at ``position`` (3,) on the robot by the robot's ``motion`` (3,), in the robot frame
    at the first image; its height does not change."""
    c, s = math.cos(motion[2]), math.sin(motion[2])
    x, y = float(position[0]), float(position[1])
    return np.array((motion[0] + c * x - s * y - x, motion[1] + s * x + c * y - y))


def nearness(pairs: RayPairs, motion: Array) -> tuple[Array, Array]:
    """The inverse depth (K,) [1/m] at which the rays of each match are nearest to each other for a robot's ``motion`` (3,),
    negative behind the camera, and its standard deviation (K,)."""
    offset = translation(pairs.position, motion)
    return _nearness(pairs.first, pairs.second, pairs.first_noise, pairs.second_noise, offset, float(motion[2]))


@compiled(error_model="numpy")
def _nearness(
    first: Array, second: Array, first_noise: Array, second_noise: Array, offset: Array, turn: float
) -> tuple[Array, Array]:
    inverse_depth, sigma = np.empty(len(first)), np.empty(len(first))
    c, s, x, y = math.cos(turn), math.sin(turn), offset[0], offset[1]
    for k in range(len(first)):
        a, b = first[k], second[k]
        u, v, w = c * b[0] - s * b[1], s * b[0] + c * b[1], b[2]  # the second ray in the first frame
        # a / rho = way + mu R b, crossed with R b
        far_x, far_y, far_z = y * w, -x * w, x * v - y * u
        squared = max(far_x * far_x + far_y * far_y + far_z * far_z, 1e-18)
        across = (a[1] * w - a[2] * v) * far_x + (a[2] * u - a[0] * w) * far_y + (a[0] * v - a[1] * u) * far_z
        noise = 0.0
        for i in range(3):
            for j in range(2):
                noise += (first_noise[k, i, j] ** 2 + second_noise[k, i, j] ** 2) / 2.0
        inverse_depth[k] = across / squared
        sigma[k] = math.sqrt(noise * (u * u + v * v + w * w) / squared)
    return inverse_depth, sigma


def from_epipole(pairs: RayPairs, motion: Array) -> Array:
    """Distance (K,) of the nearer ray of each match from the epipole after a robot ``motion`` (3,), in standard deviations of its
    pixel. Sampson's first-order error is valid if the distance is large."""
    x, y = translation(pairs.position, motion)
    c, s = math.cos(motion[2]), math.sin(motion[2])
    distances = []
    for ray, noise, tx, ty in (
        (pairs.first, pairs.first_noise, x, y),
        (pairs.second, pairs.second_noise, c * x + s * y, c * y - s * x),
    ):
        across = np.hypot(np.hypot(ray[:, 2] * ty, ray[:, 2] * tx), ray[:, 0] * ty - ray[:, 1] * tx)
        sigma = np.sqrt(np.einsum("kij,kij->k", noise, noise) / 2.0)
        distances.append(across / (sigma * max(math.hypot(tx, ty), 1e-12)))
    return np.asarray(np.minimum(*distances))


def _rays(model: CameraModel, pixels: Array) -> tuple[Array, Array]:
    local = rays(model, pixels)
    _, by_camera, _ = linearize_in_space(model, np.zeros(3), np.eye(3), local)
    # a translation of the camera moves the point in the opposite direction
    by_ray = -by_camera[:, :, 3:5]
    noise = model.sigma * np.linalg.inv(by_ray)
    return np.ascontiguousarray(local @ model.rotation.T), np.ascontiguousarray(model.rotation[:, :2] @ noise)


@compiled
def _by_pixel(noise: Array, x: float, y: float, z: float) -> tuple[float, float]:
    """The derivative by the pixel noise, from that by the ray (x, y, z) and the ray's derivative ``noise`` (3, 2)."""
    return (
        noise[0, 0] * x + noise[1, 0] * y + noise[2, 0] * z,
        noise[0, 1] * x + noise[1, 1] * y + noise[2, 1] * z,
    )


@compiled
def _shifted(ray: Array, noise: Array, u: float, v: float) -> tuple[float, float, float]:
    """A ray (3,) without the pixel noise (u, v), by its derivative ``noise`` (3, 2)."""
    return (
        ray[0] - (noise[0, 0] * u + noise[0, 1] * v),
        ray[1] - (noise[1, 0] * u + noise[1, 1] * v),
        ray[2] - (noise[2, 0] * u + noise[2, 1] * v),
    )


@compiled
def _sampson(
    first: Array,
    second: Array,
    first_noise: Array,
    second_noise: Array,
    position: Array,
    dx: float,
    dy: float,
    turn: float,
    residual: Array,
    jacobian: Array,
    signal: Array,
) -> None:
    c, s = math.cos(turn), math.sin(turn)
    lever_x, lever_y = c * position[0] - s * position[1], s * position[0] + c * position[1]
    tx, ty = dx + lever_x - position[0], dy + lever_y - position[1]
    # derivatives of tau by x and y in the robot frame at the second image, and by the rotation
    change_x, change_y = (c, -s, -lever_y), (s, c, lever_x)
    for k in range(len(first)):
        a0, a1, a2 = first[k, 0], first[k, 1], first[k, 2]
        b0, b1, b2 = second[k, 0], second[k, 1], second[k, 2]
        q0, q1 = c * b0 - s * b1, s * b0 + c * b1
        # by the first ray tau x R b, by the second one the cross product a x tau, rotated back
        g0, g1, g2 = ty * b2, -tx * b2, tx * q1 - ty * q0
        h0, h1, h2 = -a2 * ty, a2 * tx, a0 * ty - a1 * tx
        k0, k1 = c * h0 + s * h1, c * h1 - s * h0
        p, n = first_noise[k], second_noise[k]
        u0, u1 = _by_pixel(p, g0, g1, g2)
        v0, v1 = _by_pixel(n, k0, k1, h2)
        variance = u0 * u0 + u1 * u1 + v0 * v0 + v1 * v1
        if variance <= 0.0:
            residual[k] = 0.0
            jacobian[k] = 0.0
            signal[k] = 0.0
            continue
        sigma = math.sqrt(variance)
        value = (a0 * g0 + a1 * g1 + a2 * g2) / sigma
        residual[k] = value
        # the intersecting rays
        shift = value / sigma
        m0, m1, m2 = _shifted(first[k], p, shift * u0, shift * u1)
        w0, w1, w2 = _shifted(second[k], n, shift * v0, shift * v1)
        r0, r1 = c * w0 - s * w1, s * w0 + c * w1
        for j in range(3):
            sx, sy = change_x[j], change_y[j]
            dg0, dg1, dg2 = sy * b2, -sx * b2, sx * q1 - sy * q0
            dh0, dh1, dh2 = -a2 * sy, a2 * sx, a0 * sy - a1 * sx
            dk0, dk1 = c * dh0 + s * dh1, c * dh1 - s * dh0
            if j == 2:
                dg2 += tx * q0 + ty * q1  # R b rotates too
                dk0, dk1 = dk0 + k1, dk1 - k0
            du0, du1 = _by_pixel(p, dg0, dg1, dg2)
            dv0, dv1 = _by_pixel(n, dk0, dk1, dh2)
            slope = u0 * du0 + u1 * du1 + v0 * dv0 + v1 * dv1
            jacobian[k, j] = (a0 * dg0 + a1 * dg1 + a2 * dg2) / sigma - value * slope / variance
            change = m0 * sy * w2 - m1 * sx * w2 + m2 * (sx * r1 - sy * r0)
            if j == 2:
                change += m2 * (tx * r0 + ty * r1)
            signal[k, j] = change / sigma
