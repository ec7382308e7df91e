"""Compiled factors of known points against what NumPy makes of the same."""

from dataclasses import replace

import mounted_camera
import numpy as np
import pytest

from factors import se2
from factors.camera import model as reprojection
from factors.camera import update_kernels as pixel_kernels
from factors.camera.factor import ReprojectionFactor
from factors.camera.model import camera_pose, predict

MODEL = replace(mounted_camera.MODEL, sigma=1.3, tempering=0.6)
OFFSET, NOISE = np.array((0.2, -0.05, 0.3)), np.diag((1e-4, 2e-4, 1e-5))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def seen(rng, *, inexact=False, offset=None, noise=None):
    """A factor of some points with wrong ones among them, and a pose near that they are seen from."""
    pose = rng.standard_normal(3)
    position, rotation = camera_pose(MODEL, pose)
    depth = rng.uniform(0.5, 8.0, 12)
    local = depth[:, None] * np.column_stack((rng.uniform(-0.6, 0.6, 12), rng.uniform(-0.5, 0.5, 12), np.ones(12)))
    points = position + local @ rotation.T
    pixels = predict(MODEL, pose, points)[0] + rng.standard_normal((12, 2))
    pixels[:3] += 40.0
    roots = 0.03 * rng.standard_normal((12, 3, 3))
    spreads = roots @ roots.transpose(0, 2, 1) if inexact else None
    start = pose if offset is None else se2.compose(pose, se2.inverse(offset))
    factor = ReprojectionFactor(MODEL, points, pixels, offset, noise, spreads)
    return factor, se2.compose(start, se2.exp(0.03 * rng.standard_normal(3)))


@pytest.mark.parametrize("noise", [None, NOISE])
@pytest.mark.parametrize("offset", [None, OFFSET])
@pytest.mark.parametrize("inexact", [False, True])
def test_whitened_residuals_are_those_of_the_model_with_its_noise(rng, inexact, offset, noise):
    factor, pose = seen(rng, inexact=inexact, offset=offset, noise=noise)
    at = pose if offset is None else se2.compose(pose, offset)
    pixels, by_pose, by_point, by_constants = reprojection.linearize(MODEL, at, factor.points)
    spread = MODEL.sigma**2 * np.eye(2)
    if inexact:
        spread = spread + by_point @ factor.point_covariances @ by_point.transpose(0, 2, 1)
    if noise is not None:  # the error of all points
        spread = spread + len(pixels) * by_pose @ noise @ by_pose.transpose(0, 2, 1)
    whitener = np.linalg.inv(np.linalg.cholesky(np.broadcast_to(spread, (len(pixels), 2, 2))))
    back = np.eye(3) if offset is None else se2.adjoint(se2.inverse(offset))
    error, blocks = replace(factor, estimated=(2,)).whitened([pose, np.zeros(1)])
    np.testing.assert_allclose(error, np.einsum("kij,kj->ki", whitener, pixels - factor.pixels), rtol=1e-9, atol=1e-9)
    expected = by_pose @ back, by_constants[..., 2:3], reprojection.by_tilt(MODEL, by_constants)
    for block, plain in zip(blocks, expected, strict=True):
        np.testing.assert_allclose(block, whitener @ plain, rtol=1e-9, atol=1e-7)
    alone, (of_pose, of_tilt) = factor.whitened([pose])
    np.testing.assert_array_equal(alone, error)
    np.testing.assert_array_equal(np.concatenate((of_pose, of_tilt), axis=2), np.concatenate(blocks[::2], axis=2))


def test_the_camera_of_a_robot_moves_as_the_robot_does(rng):
    pose, step = rng.standard_normal(3), 1e-6
    root = rng.standard_normal((3, 3))
    position, rotation, covariance = pixel_kernels.placed(MODEL.position, MODEL.rotation, 0.0, pose, root @ root.T)
    np.testing.assert_allclose(position, camera_pose(MODEL, pose)[0])
    np.testing.assert_allclose(rotation, camera_pose(MODEL, pose)[1])
    lift = np.empty((6, 3))
    for i, moved in enumerate(step * np.eye(3)):
        there, turned = camera_pose(MODEL, se2.compose(pose, se2.exp(moved)))
        turn = (rotation.T @ turned - np.eye(3)) / step
        lift[:3, i] = turn[2, 1], turn[0, 2], turn[1, 0]
        lift[3:, i] = rotation.T @ (there - position) / step
    np.testing.assert_allclose(covariance, lift @ root @ root.T @ lift.T, atol=1e-4)
