"""The lens of the camera: its distortion and the way back, and which lenses have none."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numerical import derivative

from factors.camera.model import CameraModel, folded, linearize_in_space, project, rays, undistorted

lenses = st.builds(
    CameraModel,
    fx=st.floats(220.0, 800.0),
    fy=st.floats(220.0, 800.0),
    cx=st.floats(280.0, 360.0),
    cy=st.floats(200.0, 280.0),
    width=st.just(640),
    height=st.just(480),
    distortion=st.tuples(st.floats(-0.4, 0.4), st.floats(-0.1, 0.2), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02)),
)
pixels_of_the_image = st.lists(st.tuples(st.floats(-0.5, 639.5), st.floats(-0.5, 479.5)), min_size=1, max_size=5)
CORNERS = np.array(((-0.5, -0.5), (639.5, -0.5), (-0.5, 479.5), (639.5, 479.5)))
FLAT = (0.0, 0.0, 0.0, 0.0)
WIDE = CameraModel(300.0, 300.0, 320.0, 240.0, 640, 480, (-0.3, 0.09, 0.0, 0.0))


def brown(model, xy):
    """Pixels by the polynomial as it is written in OpenCV's manual."""
    (k1, k2, p1, p2), (x, y) = model.distortion, xy.T
    rr = x**2 + y**2
    radial = 1.0 + k1 * rr + k2 * rr**2
    u = x * radial + 2.0 * p1 * x * y + p2 * (rr + 2.0 * x**2)
    v = y * radial + p1 * (rr + 2.0 * y**2) + 2.0 * p2 * x * y
    return np.column_stack((model.fx * u + model.cx, model.fy * v + model.cy))


@given(lenses, pixels_of_the_image)
def test_directions_are_projected_back_to_their_pixels(model, pixels):
    assume(folded(model) is None)
    pixels = np.concatenate((pixels, CORNERS))
    seen = rays(model, pixels)
    np.testing.assert_allclose(project(model, seen), pixels, atol=1e-9)
    np.testing.assert_allclose(brown(model, seen[:, :2]), pixels, atol=1e-9)
    np.testing.assert_array_equal(seen[:, 2], 1.0)


@given(lenses, st.floats(-np.pi, np.pi))
def test_what_is_farther_from_the_axis_is_seen_farther_out(model, angle):
    model = replace(model, distortion=(*model.distortion[:2], 0.0, 0.0))
    radii = np.linspace(0.0, 30.0, 500)
    points = np.column_stack((radii * np.cos(angle), radii * np.sin(angle), np.ones(500)))
    seen = (project(model, points) - (model.cx, model.cy)) / (model.fx, model.fy)
    assert np.all(np.diff(np.hypot(*seen.T)) > 0.0)


@given(lenses)
def test_a_lens_without_tangential_part_is_folded_where_its_radius_grows_no_more(model):
    k1, k2, *_ = model.distortion
    model = replace(model, distortion=(k1, k2, 0.0, 0.0))
    radii = np.linspace(0.0, 2.0, 20001)
    falls = np.flatnonzero(1.0 + 3.0 * k1 * radii**2 + 5.0 * k2 * radii**4 <= 0.0)
    end = radii[falls[0] if len(falls) else -1]
    margin = (
        end * (1.0 + k1 * end**2 + k2 * end**4)
        - np.hypot(*undistorted(replace(model, distortion=FLAT), CORNERS).T).max()
    )
    assume(abs(margin) > 1e-4 and (k1, k2) != (0.0, 0.0))
    assert (folded(model) is None) == (margin > 0.0)


@given(lenses)
def test_the_determinant_is_positive_where_a_lens_is_not_folded(model):
    assume(folded(model) is None)
    v, u = np.mgrid[-0.5:479.5:17j, -0.5:639.5:23j]
    xy = undistorted(model, np.column_stack((u.ravel(), v.ravel())))
    assert np.all(np.linalg.det(derivative(lambda d: brown(model, xy + d), 2)) > -1e-3)


@pytest.mark.parametrize(
    ("focal", "distortion"),
    [
        (500.0, (-0.3, 0.0, 0.0, 0.0)),  # grows to 0.70 of the focal length, and the corner is at 0.8
        (400.0, (0.0, 0.0, 0.1, 0.1)),
        (150.0, (-0.01, 0.0, 0.0, 0.0)),  # sees 69 degrees off the axis
        (400.0, (0.0, 0.0, 0.0, -0.3)),
    ],
)
def test_lenses_that_fold_the_image(focal, distortion):
    model = CameraModel(focal, focal, 320.0, 240.0, 640, 480, distortion)
    pixel = folded(model)
    assert model.contains(pixel)
    assert np.all(np.isfinite(undistorted(model, CORNERS)))


def test_no_pixel_has_no_direction():
    assert np.isnan(undistorted(WIDE, np.array(((np.nan, 3.0),)))).all()


def test_without_distortion_the_angle_does_not_matter():
    model = CameraModel(60.0, 60.0, 320.0, 240.0, 640, 480)
    assert folded(model) is None
    np.testing.assert_allclose(undistorted(model, CORNERS), (CORNERS - (320.0, 240.0)) / 60.0)


@given(lenses, st.floats(2.1, 9.0), st.floats(-np.pi, np.pi))
def test_jacobians_far_off_the_axis_are_the_numerical_ones(model, radius, angle):
    point = 2.0 * np.array((radius * np.cos(angle), radius * np.sin(angle), 1.0))
    _, _, by_point = linearize_in_space(model, np.zeros(3), np.eye(3), point[None])
    numerical = derivative(lambda d: project(model, (point + d)[None])[0], 3)
    np.testing.assert_allclose(by_point[0], numerical, rtol=1e-4, atol=1e-2)


RATIONAL = CameraModel(400.0, 410.0, 320.0, 240.0, 640, 480, (0.3, -0.1, 1e-3, -2e-3, 0.02, 0.25, -0.05, 0.01))
FISHEYE = CameraModel(286.0, 287.0, 424.0, 400.0, 848, 800, (-0.0066, 0.0413, -0.0394, 0.0067), fisheye=True)


@pytest.mark.parametrize("model", [RATIONAL, FISHEYE], ids=["rational", "fisheye"])
@given(st.lists(st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2)), min_size=1, max_size=5))
def test_other_lenses_are_those_of_opencv(model, directions):
    points = np.column_stack((directions, np.ones(len(directions))))
    none, numbers = np.zeros(3), np.array(model.distortion)
    if model.fisheye:
        expected = cv2.fisheye.projectPoints(points[:, None], none, none, model.matrix(), numbers)[0][:, 0]
    else:
        expected = cv2.projectPoints(points, none, none, model.matrix(), numbers)[0].reshape(-1, 2)
    pixels = project(model, points)
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    np.testing.assert_allclose(undistorted(model, pixels), points[:, :2], atol=1e-9)
    by_point = linearize_in_space(model, none, np.eye(3), points)[2]
    for point, jacobian in zip(points, by_point, strict=True):
        numerical = derivative(lambda moved, point=point: project(model, (point + moved)[None])[0], 3)
        np.testing.assert_allclose(jacobian, numerical, atol=1e-4)


def test_a_fisheye_may_see_more_than_a_right_angle():
    assert folded(FISHEYE) is None
    assert folded(replace(RATIONAL, fx=150.0)) is not None
