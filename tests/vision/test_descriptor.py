"""The 37 values of a point, and the 35 that are compared."""

import numpy as np
import pytest

from factorgraph_loc.vision import descriptor
from factorgraph_loc.vision.colour_features import ColourExtractor, colour_channels
from factorgraph_loc.vision.descriptor import LOG_SCALES, OWN_SCALE, RECORD, VALUES, records, values
from factorgraph_loc.vision.images import as_image
from factorgraph_loc.vision.keypoints import Keypoints
from factorgraph_loc.vision.scale_space import ScaleSpace


def at(x: float, y: float, sigma: float, angle: float = 0.0) -> Keypoints:
    return Keypoints(np.array([[x, y]]), np.array([2.0 * sigma]), np.array([angle]), np.ones(1))


def record(image: np.ndarray, keypoints: Keypoints, *, paper_literal: bool = False) -> np.ndarray:
    intensity, *_ = colour_channels(as_image(image))
    space = ScaleSpace(intensity.shape, 0)
    space.fill(intensity)
    return records(space, keypoints, paper_literal=paper_literal)


@pytest.fixture(scope="module")
def described(picture: np.ndarray) -> tuple[Keypoints, np.ndarray]:
    return ColourExtractor(80).record(picture)


def test_position_and_scale_are_those_of_the_point(described: tuple[Keypoints, np.ndarray]) -> None:
    keypoints, found = described
    assert np.allclose(found["position"], keypoints.points, atol=1e-4)
    assert np.allclose(found["scale"], keypoints.sizes / 2.0)
    assert np.all(np.abs(found["orientation"]) <= np.pi)
    assert np.all(found["texture"] >= 0.0)


@pytest.mark.parametrize("scale", [0, 1, 2])  # the coarsest is cut by the border of its patch
def test_scale_responses_are_normalised_laplacians(scale: int) -> None:
    sigma, width = 3.0, 12.0
    y, x = np.mgrid[:240, :320]
    image = 0.2 + 0.6 * np.exp(-0.5 * ((x - 150) ** 2 + (y - 110) ** 2) / width**2)
    (found,) = record(image, at(150.0, 110.0, sigma))["scale_responses"]
    # of a Gaussian of variance v, height h, at its centre: -2 h t v / (v + t)^2
    t = (LOG_SCALES[scale] * sigma) ** 2
    expected = -2.0 * 255.0 * 0.6 * t * width**2 / (width**2 + t) ** 2
    assert np.isclose(found[0, scale], expected, rtol=0.05)


def test_orientations_are_relative_to_the_point() -> None:
    y, x = np.mgrid[:200, :200]
    slope, own = 0.9, 0.4
    image = 0.5 + 0.002 * ((x - 100) * np.cos(slope) + (y - 100) * np.sin(slope))
    (found,) = record(image, at(100.0, 100.0, 3.0, own))["orientation"]
    assert np.allclose(found, slope - own, atol=0.02)


@pytest.mark.parametrize("turn", [0, 1, 2])
def test_texture_answers_to_its_wavelength_and_direction(turn: int) -> None:
    sigma, angle = 3.0, turn * np.pi / 3.0
    y, x = np.mgrid[:200, :200]
    wave = 2.0 * np.pi / (descriptor.WAVELENGTHS[1] * sigma)
    for phase in (0.0, 1.0, 2.5):
        image = 0.5 + 0.3 * np.cos(wave * ((x - 100) * np.cos(angle) + (y - 100) * np.sin(angle)) + phase)
        (found,) = record(image, at(100.0, 100.0, sigma))["texture"]
        assert np.unravel_index(found.argmax(), found.shape) == (1, turn)
        assert np.argmax(found[1]) == turn


def test_values_are_blind_to_contrast_and_brightness(
    picture: np.ndarray, described: tuple[Keypoints, np.ndarray]
) -> None:
    keypoints, found = described
    dimmed = record(picture / 255.0 * 0.5 + 0.3, keypoints)
    assert not np.allclose(dimmed["scale_responses"], found["scale_responses"], rtol=0.2)
    assert np.abs(values(dimmed) - values(found)).max() < 0.05


def test_a_quarter_turn_leaves_the_values(picture: np.ndarray, described: tuple[Keypoints, np.ndarray]) -> None:
    keypoints, found = described
    x, y = keypoints.points.T
    points = np.stack([y, picture.shape[1] - 1.0 - x], axis=1)
    turned = Keypoints(points, keypoints.sizes, keypoints.angles - np.pi / 2.0, keypoints.responses)
    after = record(np.ascontiguousarray(np.rot90(picture)), turned)
    # where a gradient is weak its direction is not certain, and octaves count pixels from the other side
    change = np.abs(values(after) - values(found))
    assert np.median(change) < 0.01
    assert np.mean(change < 0.1) > 0.97


def test_angles_that_wrap_are_one_value() -> None:
    found = np.zeros(2, dtype=RECORD)
    found["scale"] = 1.0
    found["orientation"][:, 1] = np.pi, -np.pi + 1e-6
    assert np.allclose(*values(found), atol=1e-5)


def test_the_own_scale_is_where_the_weights_expect_it() -> None:
    found = np.zeros(2, dtype=RECORD)
    found["scale"] = 1.0, 4.0
    assert np.allclose(np.diff(values(found), axis=0)[0], 2.0 * (np.arange(VALUES) == OWN_SCALE))


def test_literal_neighbours_are_the_nearest_points(
    picture: np.ndarray, described: tuple[Keypoints, np.ndarray]
) -> None:
    keypoints, found = described
    _, literal = ColourExtractor(80, paper_literal=True).record(picture)
    away = np.linalg.norm(keypoints.points[:, None] - keypoints.points, axis=2)
    near = np.argsort(away, axis=1)[:, 1:5]
    assert np.array_equal(literal["scale_responses"][:, 0], found["scale_responses"][:, 0])
    assert np.array_equal(literal["scale_responses"][:, 1:], found["scale_responses"][near, 0])
    turned = np.exp(1j * (keypoints.angles[near] - keypoints.angles[:, None]))
    assert np.allclose(np.exp(1j * literal["orientation"][:, 1:]), turned, atol=1e-5)
    assert np.array_equal(literal["texture"], found["texture"])


@pytest.mark.parametrize("count", [0, 1, 3])
def test_literal_neighbours_that_are_too_few(picture: np.ndarray, count: int) -> None:
    keypoints = ColourExtractor(5).detect(picture)[:count]
    literal = record(picture, keypoints, paper_literal=True)
    assert len(literal) == count
    assert np.array_equal(literal["scale_responses"][:, 4], literal["scale_responses"][:, 0])
