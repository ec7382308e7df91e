"""The motion between two images: consistent with its information, and robust to what does not belong to it."""

import numpy as np
import pytest
from scipy import stats

from factorgraph_loc.vision.frame_motion import FrameMotion, frame_motion
from factors import se2
from factors.camera.model import CameraModel, mounting, predict
from factors.motion import Increment
from factors.se2 import Array

MODEL = CameraModel(
    500.0,
    500.0,
    319.5,
    239.5,
    640,
    480,
    distortion=(-0.05, 0.01, 0.0005, -0.0005),
    position=np.array((0.2, 0.0, 0.9)),
    rotation=mounting(0.0, -0.05, 0.1),
    sigma=0.8,
)
SIDEWAYS = CameraModel(500.0, 500.0, 319.5, 239.5, 640, 480, rotation=mounting(0.0, 0.0, np.pi / 2), sigma=0.8)
SIGMAS = np.array((0.02, 0.01, 0.02))  # of the odometry, m, m, rad


def seen(rng: np.random.Generator, motion: Array, count: int = 150, model: CameraModel = MODEL) -> tuple[Array, Array]:
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


def around(rng: np.random.Generator, motion: Array, width: float = 1.0) -> Increment:
    """What odometry predicts of a motion."""
    error = width * SIGMAS * rng.standard_normal(3)
    return Increment(se2.compose(motion, se2.exp(error)), np.diag((width * SIGMAS) ** 2), 0.5)


def squared(found: FrameMotion, truth: Array) -> float:
    error = se2.log(se2.between(found.delta, truth))
    return float(error @ found.information @ error)


@pytest.mark.parametrize("model", [MODEL, SIDEWAYS], ids=["ahead", "sideways"])
def test_errors_are_as_large_as_the_information_says(model: CameraModel) -> None:
    # 40 runs of two degrees of freedom: the mean leaves the two-sided 99.9 % band of the chi-square once in a thousand; Huber's
    # weights and linearisation are allowed 10 %
    rng = np.random.default_rng(11)
    sums = []
    for _ in range(40):
        motion = np.array((rng.uniform(0.15, 0.4), rng.normal(0.0, 0.01), rng.normal(0.0, 0.15)))
        found = frame_motion(model, *seen(rng, motion, model=model), around(rng, motion), rng)
        assert found is not None
        assert np.linalg.eigvalsh(found.information)[0] < 1e-9 * found.information.max()
        assert found.information[:2].any()
        sums.append(squared(found, motion))
    low, high = stats.chi2.ppf((0.0005, 0.9995), 80) / 80
    assert 0.9 * low < np.mean(sums) / 2.0 < 1.1 * high


def test_it_tells_more_than_the_odometry_did() -> None:
    rng = np.random.default_rng(12)
    motion = np.array((0.3, 0.0, 0.05))
    found = frame_motion(MODEL, *seen(rng, motion), around(rng, motion), rng)
    assert found is not None
    assert found.information[2, 2] > 4.0 / SIGMAS[2] ** 2
    way = found.delta[:2] / np.linalg.norm(found.delta[:2])
    assert way @ se2.transform_to(np.zeros(3), found.information[:2, :2] @ way) < 1.0 / SIGMAS[0] ** 2


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_wrong_matches_do_not_matter(share: float) -> None:
    rng = np.random.default_rng(13)
    for _ in range(10):
        motion = np.array((0.3, 0.0, rng.normal(0.0, 0.1)))
        first, second = seen(rng, motion)
        wrong = rng.choice(len(first), int(share * len(first)), replace=False)
        second[wrong] = rng.uniform((0.0, 0.0), (640.0, 480.0), (len(wrong), 2))
        found = frame_motion(MODEL, first, second, around(rng, motion), rng)
        assert found is not None
        assert squared(found, motion) < stats.chi2.ppf(0.99999, 2)
        # a wrong match may lie near its epipolar line: of one in the whole image about 7 sigmas in 480 pixels
        assert found.agrees[wrong].mean() < 0.2


@pytest.mark.parametrize("motion", [(0.3, 0.0, 0.05), (0.0, 0.0, 0.0)], ids=["driving", "at rest"])
def test_a_thing_that_moves_over_a_third_of_the_image(motion: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(14)
    truth = np.array(motion)
    for _ in range(10):
        first, second = seen(rng, truth)
        moving = first[:, 0] < np.quantile(first[:, 0], 1.0 / 3.0)
        second[moving] += rng.normal((25.0, -12.0), 1.0, (int(moving.sum()), 2))
        found = frame_motion(MODEL, first, second, around(rng, truth), rng)
        assert found is not None
        assert squared(found, truth) < stats.chi2.ppf(0.99999, 2)
        assert found.agrees[moving].mean() < 0.3


def test_at_rest_and_turning_on_the_spot_only_the_turn_is_told() -> None:
    # 50 runs of one degree of freedom, as above; the prior of the way makes the information less than it could be
    rng = np.random.default_rng(15)
    sums = []
    for _ in range(50):
        motion = np.array((0.0, 0.0, rng.choice((0.0, 0.2, -0.1))))
        model = CameraModel(500.0, 500.0, 319.5, 239.5, 640, 480, rotation=mounting(0.0, 0.0, 0.2), sigma=0.8)
        found = frame_motion(model, *seen(rng, motion, model=model), around(rng, motion, 0.1), rng)
        assert found is not None
        assert not found.information[:2].any()
        assert found.information[2, 2] > 1.0 / 0.01**2
        sums.append(squared(found, motion))
    assert stats.chi2.ppf(0.0005, 50) / 50 * 0.5 < np.mean(sums) < stats.chi2.ppf(0.9995, 50) / 50


def test_a_bad_prediction_is_corrected() -> None:
    rng = np.random.default_rng(16)
    motion = np.array((0.3, 0.0, 0.3))
    slipped = Increment(np.array((0.3, 0.0, 0.05)), np.diag(SIGMAS**2), 0.5)
    found = frame_motion(MODEL, *seen(rng, motion), slipped, rng)
    assert found is not None
    assert abs(found.delta[2] - motion[2]) < 0.01


def test_few_or_contradicting_matches_tell_nothing() -> None:
    rng = np.random.default_rng(17)
    motion = np.array((0.3, 0.0, 0.0))
    first, second = seen(rng, motion)
    assert frame_motion(MODEL, first[:7], second[:7], around(rng, motion), rng) is None
    scattered = rng.uniform((0.0, 0.0), (640.0, 480.0), second.shape)
    assert frame_motion(MODEL, first, scattered, around(rng, motion), rng) is None
    assert frame_motion(MODEL, first[:0], second[:0], around(rng, motion), rng) is None


def test_all_of_one_pixel_is_finite() -> None:
    rng = np.random.default_rng(18)
    same = np.tile((300.0, 200.0), (20, 1))
    found = frame_motion(MODEL, same, same, around(rng, np.zeros(3)), rng)
    assert found is None or np.all(np.isfinite(found.information))
