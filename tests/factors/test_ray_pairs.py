"""What matches tell of a motion: the error of one match in closed form, Jacobians, and what cannot be seen."""

import numpy as np
import pytest
from mounted_camera import MODEL
from numerical import by_pose as numerical

from factors import se2
from factors.camera.model import CameraModel, mounting, predict
from factors.camera.ray_pairs import RayPairs, from_epipole, nearness, sampson, translation
from factors.se2 import Array

MOTION = np.array((0.3, 0.04, 0.12))


def seen(rng: np.random.Generator, motion: Array, count: int = 40) -> tuple[Array, Array]:
    """Pixels of points in front of the camera before and after a motion."""
    points = np.column_stack(
        (rng.uniform(2.0, 8.0, count), rng.uniform(-2.0, 3.0, count), rng.uniform(0.0, 2.5, count))
    )
    return predict(MODEL, np.zeros(3), points)[0], predict(MODEL, motion, points)[0]


def test_matches_without_noise_have_no_error() -> None:
    pairs = RayPairs.of(MODEL, *seen(np.random.default_rng(1), MOTION))
    assert np.abs(sampson(pairs, MOTION)[0]).max() < 1e-6
    assert np.abs(sampson(pairs, MOTION + np.array((0.0, 0.1, 0.0)))[0]).max() > 1.0


def test_the_jacobian_is_the_numerical_one() -> None:
    rng = np.random.default_rng(2)
    first, second = seen(rng, MOTION)
    pairs = RayPairs.of(MODEL, first + rng.normal(0.0, 3.0, first.shape), second)
    _, jacobian, _ = sampson(pairs, MOTION)
    found = numerical(lambda m: sampson(pairs, m)[0], MOTION)
    np.testing.assert_allclose(jacobian, found, atol=1e-5 * np.abs(found).max())


def test_the_error_is_the_distance_to_the_epipolar_lines() -> None:
    # a camera that moves to its side: lines are the rows of the image, and both pixels share what misses
    model = CameraModel(500.0, 500.0, 320.0, 240.0, 640, 480, rotation=mounting(0.0, 0.0, np.pi / 2), sigma=2.0)
    pairs = RayPairs.of(model, np.array(((300.0, 200.0),)), np.array(((310.0, 203.0),)))
    residual, _, _ = sampson(pairs, np.array((0.5, 0.0, 0.0)))
    assert abs(residual[0]) == pytest.approx(3.0 / (np.sqrt(2.0) * 2.0))


def test_the_length_of_the_way_is_not_seen() -> None:
    rng = np.random.default_rng(3)
    first, second = seen(rng, MOTION)
    pairs = RayPairs.of(MODEL, first + rng.normal(0.0, 0.7, first.shape), second)
    residual, jacobian, signal = sampson(pairs, MOTION)
    way = translation(MODEL.position, MOTION)
    back = se2.transform_to(np.array((0.0, 0.0, MOTION[2])), way)
    for slopes in (jacobian, signal):
        assert np.abs(slopes @ (*back, 0.0)).max() < 1e-3 * np.abs(slopes).max()
    longer = MOTION + np.append(0.3 * way, 0.0)
    np.testing.assert_allclose(sampson(pairs, longer)[0], residual, atol=1e-9)


def test_a_camera_that_stays_tells_nothing_and_is_finite() -> None:
    pairs = RayPairs.of(MODEL, *seen(np.random.default_rng(4), MOTION))
    residual, jacobian, signal = sampson(pairs, np.zeros(3))
    assert not residual.any()
    assert not jacobian.any()
    assert not signal.any()


def test_sampson_errors_of_noisy_matches_are_standard_normal() -> None:
    # mean square of 4,000: a standard deviation of 0.022, so 4 of them is a false alarm in 16,000
    rng = np.random.default_rng(5)
    first, second = seen(rng, MOTION, 4000)
    noisy = [pixels + rng.normal(0.0, MODEL.sigma, pixels.shape) for pixels in (first, second)]
    residual, _, _ = sampson(RayPairs.of(MODEL, *noisy), MOTION)
    assert np.mean(residual**2) == pytest.approx(1.0, abs=0.09)


def test_of_matches_without_noise_the_constraint_s_slope_is_the_jacobian() -> None:
    pairs = RayPairs.of(MODEL, *seen(np.random.default_rng(7), MOTION))
    _, jacobian, signal = sampson(pairs, MOTION)
    np.testing.assert_allclose(signal, jacobian, atol=1e-6 * np.abs(jacobian).max())


def test_rays_meet_at_the_points_depth() -> None:
    points = np.array(((3.0, 0.8, 1.0), (6.0, 2.0, 0.4), (2.0, 0.3, 1.2)))
    first, second = predict(MODEL, np.zeros(3), points)[0], predict(MODEL, MOTION, points)[0]
    rho, sigma = nearness(RayPairs.of(MODEL, first, second), MOTION)
    np.testing.assert_allclose(1.0 / rho, predict(MODEL, np.zeros(3), points)[1], rtol=1e-6)
    assert np.all((sigma > 0.0) & (sigma < 0.1))


def test_a_match_seen_where_the_camera_goes_is_at_the_epipole() -> None:
    model = CameraModel(500.0, 500.0, 320.0, 240.0, 640, 480, sigma=2.0)
    ahead, beside = np.array((320.0, 240.0)), np.array((420.0, 240.0))
    away = from_epipole(
        RayPairs.of(model, np.array((ahead, beside)), np.array((ahead, beside))), np.array((0.5, 0.0, 0.0))
    )
    assert away == pytest.approx((0.0, 50.0))
