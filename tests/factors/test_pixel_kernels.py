"""Where a camera is in the world, compiled, against what NumPy makes of the same."""

from dataclasses import replace

import mounted_camera
import numpy as np
import pytest

from factors import se2
from factors.camera import update_kernels as pixel_kernels
from factors.camera.model import camera_pose

MODEL = replace(mounted_camera.MODEL, sigma=1.3, tempering=0.6)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


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
