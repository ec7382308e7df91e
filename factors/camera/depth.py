"""The depth of a pixel as a third value of its measurement: the inverse of the depth along the optical axis.

A structured-light or stereo camera measures a disparity, so the noise of the inverse depth is the same at all distances
(Khoshelham, Elberink, "Accuracy and resolution of Kinect depth data for indoor mapping applications", Sensors 12(2), 2012, section
4.2), as that of a virtual second camera is in pixels (Mur-Artal, Tardos, "ORB-SLAM2", IEEE Transactions on Robotics 33(5), 2017).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factors.camera.model import CameraModel, linearize_in_space, undistorted
from factors.se2 import Array

LEAST = 1e-3  # m: points nearer than this, or behind the camera, have no inverse depth


def linearize_inverse_depth(rotations: Array, local: Array) -> tuple[Array, Array, Array]:
    """The inverse depths (N,) [1/m] of points ``local`` (N, 3) in cameras with orientations ``rotations`` (N, 3, 3), and their
    derivatives by the camera (N, 6), a perturbation in its own frame, rotation first, and by the point in the world (N, 3)."""
    inverse = 1.0 / np.maximum(local[:, 2], LEAST)
    squared = np.square(inverse)
    by_camera = np.zeros((len(local), 6))
    # the point moves by -turn x local - shift
    by_camera[:, 0], by_camera[:, 1] = local[:, 1] * squared, -local[:, 0] * squared
    by_camera[:, 5] = squared
    return inverse, by_camera, -squared[:, None] * rotations[:, :, 2]


def linearize_with_depth(
    model: CameraModel, position: Array, rotation: Array, points: Array, measured: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:
    """Pixels and inverse depths (K, 3) of ``points`` (K, 3), and the Jacobians (K, 3, 6) and (K, 3, 3), as in
    :func:`~factors.camera.model.linearize_in_space`; the third rows are zero where no depth was ``measured`` (K,)."""
    pixels, by_camera, by_point = linearize_in_space(model, position, rotation, points)
    rotations = np.broadcast_to(rotation, (len(points), 3, 3))
    deep = linearize_inverse_depth(rotations, (points - position) @ rotation)
    inverse, camera_by_depth, point_by_depth = (np.where(measured, part.T, 0.0).T[:, None] for part in deep)
    return (
        np.hstack((pixels, inverse)),
        np.concatenate((by_camera, camera_by_depth), axis=1),
        np.concatenate((by_point, point_by_depth), axis=1),
    )


def with_inverse(pixels: Array, depths: Array | None) -> Array:
    """``pixels`` (K, 2) with the inverse of ``depths`` (K,) [m] as a third value, 0 where that is NaN; as they are without any."""
    return pixels if depths is None else np.column_stack((pixels, np.nan_to_num(1.0 / depths)))


def lifted(model: CameraModel, pixels: Array, depths: Array) -> Array:
    """The points (N, 3) in the camera's frame that are seen at ``pixels`` (N, 2), at ``depths`` (N,) [m]."""
    return np.column_stack((undistorted(model, pixels), np.ones(len(pixels)))) * depths[:, None]
