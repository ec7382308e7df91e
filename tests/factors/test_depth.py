"""The inverse depth of a pixel."""

import numpy as np
from scipy.spatial.transform import Rotation

from factors.camera.depth import lifted, linearize_inverse_depth
from factors.camera.model import CameraModel, project


def test_jacobians_of_the_inverse_depth():
    """Central differences with steps of 1e-6: wrong by less than 1e-8."""
    rng = np.random.default_rng(0)
    rotations = Rotation.from_rotvec(rng.standard_normal((20, 3))).as_matrix()
    positions = rng.standard_normal((20, 3))
    local = np.column_stack((rng.standard_normal((20, 2)), rng.uniform(0.5, 4.0, 20)))
    points = positions + np.einsum("nij,nj->ni", rotations, local)

    def inverse(camera, point):
        turned = rotations @ Rotation.from_rotvec(camera[:3]).as_matrix()
        there = positions + rotations @ camera[3:]
        return 1.0 / np.einsum("ni,ni->n", points + point - there, turned[:, :, 2])

    found, by_camera, by_point = linearize_inverse_depth(rotations, local)
    np.testing.assert_allclose(found, 1.0 / local[:, 2])
    for jacobian, place in ((by_camera, 0), (by_point, 1)):
        for k, step in enumerate(1e-6 * np.eye(jacobian.shape[1])):
            ahead, back = [np.zeros(6), np.zeros(3)], [np.zeros(6), np.zeros(3)]
            ahead[place], back[place] = step, -step
            np.testing.assert_allclose((inverse(*ahead) - inverse(*back)) / 2e-6, jacobian[:, k], atol=1e-8)


def test_a_pixel_with_a_depth_is_a_point():
    model = CameraModel(525.0, 520.0, 320.0, 240.0, 640, 480, distortion=(0.05, -0.02, 0.001, 0.0))
    rng = np.random.default_rng(1)
    points = np.column_stack((rng.uniform(-0.5, 0.5, (10, 2)), rng.uniform(1.0, 3.0, 10)))
    np.testing.assert_allclose(lifted(model, project(model, points), points[:, 2]), points, atol=1e-6)
