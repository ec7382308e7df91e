"""Points by inverse depth: Jacobians against numerical ones, and what they are for."""

import numpy as np
import pytest
from numerical import derivative as numerical
from scipy.spatial.transform import Rotation

from factors.camera import inverse_depth
from factors.camera.model import CameraModel, linearize_in_space, mounting

MODEL = CameraModel(
    fx=410.0, fy=415.0, cx=320.0, cy=240.0, width=640, height=480, distortion=(-0.06, 0.01, 4e-4, -3e-4)
)
POSITION = np.array((0.4, -0.2, 1.1))
ROTATION = mounting(0.05, -0.1, 0.3)
RAYS = np.array(
    (
        (0.0, 0.1, 1.0, 0.25, 0.1, 0.3),
        (0.3, -0.4, 1.2, 0.6, -0.05, 0.9),
        (-0.2, 0.0, 0.9, 0.1, 0.3, 0.0),  # infinitely far
    )
)


def moved(delta):
    return POSITION + ROTATION @ delta[3:], ROTATION @ Rotation.from_rotvec(delta[:3]).as_matrix()


def test_pixels_depend_on_the_camera_and_on_the_ray_as_stated():
    pixels, by_camera, by_rays = inverse_depth.linearize(MODEL, POSITION, ROTATION, RAYS)
    found = numerical(lambda d: inverse_depth.linearize(MODEL, *moved(d), RAYS)[0], 6)
    np.testing.assert_allclose(by_camera, found, rtol=1e-5, atol=1e-4)
    found = numerical(lambda d: inverse_depth.linearize(MODEL, POSITION, ROTATION, RAYS + d)[0], 6)
    np.testing.assert_allclose(by_rays, found, rtol=1e-5, atol=1e-4)
    assert np.all(np.isfinite(pixels))


def test_a_ray_is_seen_where_its_point_is():
    points, jacobian = inverse_depth.positions(RAYS[:2])
    expected, *_ = linearize_in_space(MODEL, POSITION, ROTATION, points)
    np.testing.assert_allclose(inverse_depth.linearize(MODEL, POSITION, ROTATION, RAYS[:2])[0], expected, atol=1e-9)
    found = numerical(lambda d: inverse_depth.positions(RAYS[:2] + d)[0], 6)
    np.testing.assert_allclose(jacobian, found, rtol=1e-5, atol=1e-5)


def test_a_new_ray_is_seen_at_its_pixel_whatever_its_depth():
    pixel = np.array((500.0, 100.0))
    for inverse in (0.01, 1.0):
        ray, by_camera, by_seen = inverse_depth.begin(MODEL, POSITION, ROTATION, pixel, inverse)
        seen, *_ = inverse_depth.linearize(MODEL, POSITION, ROTATION, ray[None])
        np.testing.assert_allclose(seen[0], pixel, atol=1e-6)
    found = numerical(lambda d: inverse_depth.begin(MODEL, *moved(d), pixel, 1.0)[0], 6)
    np.testing.assert_allclose(by_camera, found, rtol=1e-5, atol=1e-6)
    found = numerical(lambda d: inverse_depth.begin(MODEL, POSITION, ROTATION, pixel + d[:2], 1.0 + d[2])[0], 3)
    np.testing.assert_allclose(by_seen, found, rtol=1e-4, atol=1e-6)


def test_what_lies_behind_the_camera_is_seen_nowhere_in_the_image():
    behind = RAYS[:1] + np.array((0.0, 0.0, 0.0, np.pi, 0.0, 0.0))
    pixels, *jacobians = inverse_depth.linearize(MODEL, POSITION, ROTATION, behind)
    assert not MODEL.contains(pixels).any()
    assert all(np.all(np.isfinite(j)) for j in jacobians)


def test_a_depth_becomes_linear_with_certainty_and_never_beyond_infinity():
    rays = np.repeat(RAYS[:1], 3, axis=0)
    rays[2, 5] = -0.1
    index = inverse_depth.linearity(rays, np.array((0.3, 0.003, 0.003)), POSITION)
    assert index[0] > inverse_depth.LINEAR > index[1]
    assert index[2] == np.inf
    # seen from across the ray, the depth does not bend the pixel
    across = inverse_depth.positions(rays[:1])[0][0] + np.array((np.sin(0.25), -np.cos(0.25), 0.0))
    assert inverse_depth.linearity(rays[:1], np.array((0.3,)), across)[0] == pytest.approx(0.0, abs=1e-6)
