"""The turn between two images: errors as large as their standard deviation, and matches that do not fit the motion."""

import numpy as np
import pytest
from mounted_camera import MODEL
from scipy import stats

from factorgraph_loc.vision.image_turn import measure_turn
from factors.camera.model import CameraModel, mounting, predict
from factors.se2 import Array

SIDEWAYS = CameraModel(500.0, 500.0, 319.5, 239.5, 640, 480, rotation=mounting(0.0, 0.0, np.pi / 2), sigma=0.8)


def seen(rng: np.random.Generator, motion: Array, model: CameraModel = MODEL, count: int = 150) -> tuple[Array, Array]:
    """Pixels, with noise, of points that are in the image before and after a motion."""
    depth = rng.uniform(2.0, 9.0, 20 * count)
    place = np.column_stack(
        (depth * rng.uniform(-0.7, 0.7, depth.size), depth * rng.uniform(-0.5, 0.5, depth.size), depth)
    )
    points = place @ model.rotation.T + model.position
    first, second = predict(model, np.zeros(3), points)[0], predict(model, motion, points)[0]
    both = np.flatnonzero(model.contains(first) & model.contains(second))[:count]
    noise = rng.normal(0.0, model.sigma, (2, count, 2))
    return first[both] + noise[0], second[both] + noise[1]


@pytest.mark.parametrize("model", [MODEL, SIDEWAYS], ids=["ahead", "sideways"])
def test_errors_of_turn_and_focal_length_are_as_large_as_their_sigma(model: CameraModel) -> None:
    # 40 runs: the sum of squares leaves the two-sided 99.9 % band of the chi-square once in a thousand; Huber's weights and
    # linearisation are allowed 20 %
    rng, squares = np.random.default_rng(11), np.zeros(2)
    for _ in range(40):
        motion = np.array((rng.uniform(0.15, 0.4), rng.normal(0.0, 0.01), rng.normal(0.0, 0.15)))
        starts = [motion + np.array((0.02, 0.01, turn)) for turn in np.linspace(-0.105, 0.095, 41)]
        measured = measure_turn(model, *seen(rng, motion, model), starts)
        assert measured is not None
        (turn, sigma), (focal, focal_sigma) = measured
        squares += ((turn - motion[2]) / sigma) ** 2, (focal / focal_sigma) ** 2
    low, high = stats.chi2.ppf((0.0005, 0.9995), 40)
    assert np.all((squares > low / 1.2) & (squares < 1.2 * high))


def test_points_of_a_moving_thing_do_not_change_the_turn() -> None:
    rng, motion = np.random.default_rng(3), np.array((0.3, 0.0, 0.1))
    first, second = seen(rng, motion)
    second[:50] += (25.0, 10.0)
    measured = measure_turn(MODEL, first, second, [motion])
    assert measured is not None
    assert abs(measured[0][0] - motion[2]) < 5.0 * measured[0][1]  # false alarm: below 1e-6


def test_too_few_matches_or_inliers_give_no_turn() -> None:
    rng, motion = np.random.default_rng(5), np.array((0.3, 0.0, 0.1))
    first, second = seen(rng, motion)
    assert measure_turn(MODEL, first[:7], second[:7], [motion]) is None
    assert measure_turn(MODEL, first, rng.uniform(0.0, 480.0, second.shape), [motion]) is None
