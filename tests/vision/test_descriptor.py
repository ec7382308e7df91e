"""The 37 values of a point, and the 35 that are compared."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from factorgraph_loc.vision import descriptor
from factorgraph_loc.vision.colour_features import ColourExtractor, colour_channels
from factorgraph_loc.vision.descriptor import LOG_SCALES, OWN_SCALE, RECORD, VALUES, records, values
from factorgraph_loc.vision.detector import CLEARANCE, orientations
from factorgraph_loc.vision.features import extractor
from factorgraph_loc.vision.images import as_image
from factorgraph_loc.vision.kernels import locally_strongest, refined_peaks
from factorgraph_loc.vision.keypoints import Keypoints
from factorgraph_loc.vision.scale_space import FINEST, SCALES, SIGMAS, STEP, ScaleSpace


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


def blob(x: float, y: float, sigma: float) -> np.ndarray:
    """A Gaussian (120, 160) of height 1 around a point."""
    v, u = np.mgrid[:120, :160]
    return np.asarray(np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / sigma**2))


def strongest(image: np.ndarray) -> tuple[np.ndarray, float]:
    keypoints = extractor("colour", 1).detect(image)
    assert len(keypoints) == 1
    return keypoints.points[0], float(keypoints.sizes[0])


@pytest.mark.parametrize("shift", [(0.3, 0.0), (0.5, 0.5), (2.25, -1.6)])
def test_points_move_by_fractions_of_a_pixel_with_the_image(picture: np.ndarray, shift: tuple[float, float]) -> None:
    smooth = cv2.GaussianBlur(picture, (0, 0), 1.5).astype(float) / 255.0
    moved = np.dstack([ndimage.shift(smooth[..., c], shift[::-1], mode="mirror") for c in range(3)])
    before, after = (extractor("colour", 100).detect(np.clip(image, 0.0, 1.0)) for image in (smooth, moved))
    expected = before.points + shift
    nearest = np.linalg.norm(expected[:, None] - after.points, axis=2).argmin(axis=1)
    away = np.linalg.norm(expected - after.points[nearest], axis=1) / before.sizes
    assert np.median(away) < 0.05  # whole pixels would give 0.1
    assert np.mean(away < 0.2) > 0.8


@pytest.mark.parametrize("side", [9, 17, 33])
def test_the_corners_of_a_square_are_found(side: int) -> None:
    image = np.full((120, 160), 60, dtype=np.uint8)
    image[40 : 40 + side, 60 : 60 + side] = 190
    points = extractor("colour", 20).detect(image).points
    low, high = np.array((60.0, 40.0)) - 0.5, np.array((60.0, 40.0)) + side - 0.5
    for corner in ((low[0], low[1]), (low[0], high[1]), (high[0], low[1]), (high[0], high[1])):
        assert np.linalg.norm(points - corner, axis=1).min() < 3.0


def test_an_edge_has_no_points() -> None:
    image = np.full((120, 160), 60, dtype=np.uint8)
    image[:, 80:] = 190
    assert len(extractor("colour").detect(image)) == 0


def test_colour_that_grey_does_not_see_is_found() -> None:
    # red and green of the same luminance E
    pattern = blob(60.0, 50.0, 4.0)[..., None]
    red, green = np.array((0.0, 20.0, 200.0)), np.array((0.0, 20.0 + 100.0 * 0.06 / 0.63, 100.0))
    image = (red * (1.0 - pattern) + green * pattern) / 255.0
    weights = np.array((0.27, 0.63, 0.06))
    assert np.ptp(np.rint(image * 255.0) @ weights) < 1.0
    point, _ = strongest(image)
    assert np.linalg.norm(point - (60.0, 50.0)) < 3.0
    assert len(extractor("colour").detect((image @ weights).astype(np.float32))) == 0


def test_the_weaker_of_two_that_are_close_waits(picture: np.ndarray) -> None:
    few, all_of_them = (extractor("colour", count).detect(picture) for count in (150, 10**6))
    sigmas = few.sizes / 2.0
    apart = np.linalg.norm(few.points[:, None] - few.points, axis=2)
    alike = np.abs(np.log(sigmas[:, None] / sigmas)) <= np.log(STEP)
    # row: a stronger one; column: a weaker one, whose clearance counts
    stronger = np.triu(np.ones_like(alike), k=1)
    assert not np.any(stronger & alike & (apart < CLEARANCE * sigmas))
    # without the clearance others would be among them
    assert set(map(tuple, few.points)) != set(map(tuple, all_of_them.points[:150]))
    assert set(map(tuple, few.points)) < set(map(tuple, all_of_them.points))


@pytest.mark.parametrize("angle", np.linspace(-3.1, 3.1, 9))
def test_the_direction_is_that_of_the_gradient(angle: float) -> None:
    v, u = np.mgrid[:120, :160]
    ramp = 100.0 + 0.5 * ((u - 80) * np.cos(angle) + (v - 60) * np.sin(angle))
    space = ScaleSpace(ramp.shape, 0)
    space.fill(ramp.astype(np.float32))
    (found,) = orientations(space, np.array([[80.0, 60.0]]), np.array([3.0]))
    assert abs(np.angle(np.exp(1j * (found - angle)))) < 0.02


def test_planes_are_blurred_to_their_scales() -> None:
    space = ScaleSpace((257, 257), 0)
    impulse = np.zeros((257, 257), dtype=np.float32)
    impulse[128, 128] = 1.0
    space.fill(impulse)
    for octave in space.octaves[:3]:
        height, width = octave.planes.shape[1:]
        y, x = np.mgrid[:height, :width] * octave.step - 128.0
        for sigma, plane in zip(SIGMAS, octave.planes, strict=True):
            weights = plane / plane.sum()
            for away in (x, y):
                assert np.isclose(np.sqrt((weights * away**2).sum()), sigma * octave.step, rtol=0.02)
                assert abs((weights * away).sum()) < 1e-3


def test_octaves_end_at_sixteen_pixels() -> None:
    assert [octave.planes.shape[1:] for octave in ScaleSpace((100, 131), 0).octaves] == [(100, 131), (50, 66), (25, 33)]
    assert len(ScaleSpace((16, 16), 2).octaves) == 1
    assert ScaleSpace((64, 48), 2).octaves[1].colours.shape == (2, 32, 24)


def test_levels_are_the_nearest_scales_of_all_octaves() -> None:
    space = ScaleSpace((64, 64), 0)
    scales = FINEST * STEP ** np.arange(3 * SCALES)
    assert np.array_equal(space.levels(scales * 1.05), np.arange(3 * SCALES))
    assert space.levels(np.array([0.1, 1e3])).tolist() == [0, 3 * SCALES - 1]


@pytest.mark.parametrize("sigma", [1.3, 2.9, 6.0])
def test_patches_of_a_slope_are_the_slope(sigma: float) -> None:
    space = ScaleSpace((200, 240), 0)
    y, x = np.mgrid[:200, :240].astype(np.float32)
    space.fill(2.0 * x - 3.0 * y)
    offsets = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0], [-3.0, 1.0]], dtype=np.float32)
    point, angle = np.array([[111.3, 93.6]]), 0.7
    patch = space.patches(point, np.array([sigma]), np.array([angle]), offsets)[0]
    c, s = np.cos(angle), np.sin(angle)
    places = point + sigma * offsets @ np.array([[c, s], [-s, c]])
    assert np.allclose(patch, places @ (2.0, -3.0), atol=0.01)


def test_memory_that_is_used_again_keeps_nothing() -> None:
    rng = np.random.default_rng(5)
    first, second = rng.normal(size=(2, 50, 60)).astype(np.float32)
    used, new = ScaleSpace((50, 60), 0), ScaleSpace((50, 60), 0)
    used.fill(first)
    used.fill(second)
    new.fill(second)
    assert all(np.array_equal(a.planes, b.planes) for a, b in zip(used.octaves, new.octaves, strict=True))


def peaks_of(strength: np.ndarray, planes: np.ndarray, threshold: float = 0.0) -> np.ndarray:
    peaks = np.empty((1, 5))
    pixels = np.array([[6, 5]], dtype=np.int32)
    count = refined_peaks(strength, threshold, planes, np.array([0.5, 1.0, 2.0]), pixels, peaks)
    return peaks[:count]


def cones(heights: tuple[float, float, float]) -> np.ndarray:
    """Planes whose Laplacian at (6, 5) is -4 times the heights, weighted as in peaks_of."""
    planes = np.zeros((3, 11, 13), dtype=np.float32)
    planes[:, 5, 6] = np.array(heights) / np.array([0.5, 1.0, 2.0])
    return planes


def test_a_paraboloid_gives_its_own_vertex() -> None:
    y, x = np.mgrid[:11, :13]
    strength = (9.0 - (x - 6.3) ** 2 - 2.0 * (y - 4.8) ** 2 + 0.5 * (x - 6.3) * (y - 4.8)).astype(np.float32)
    # Laplacians 4, 5, 3: the parabola through them has its vertex at -1/6
    (peak,) = peaks_of(strength, cones((1.0, 1.25, 0.75)))
    assert np.allclose(peak[:3], (6.3, 4.8, -1.0 / 6.0), atol=1e-4)
    assert np.allclose(peak[3:], (strength[5, 6], 5.0))


def test_what_is_weak_or_stronger_at_another_scale_is_dropped() -> None:
    y, x = np.mgrid[:11, :13]
    strength = (9.0 - (x - 6.0) ** 2 - (y - 5.0) ** 2).astype(np.float32)
    assert len(peaks_of(strength, cones((1.0, 1.25, 0.75)))) == 1
    assert len(peaks_of(strength, cones((1.0, 1.25, 0.75)), threshold=9.0)) == 0
    assert len(peaks_of(strength, cones((1.5, 1.25, 0.75)))) == 0
    assert len(peaks_of(strength, cones((1.0, 1.25, 1.5)))) == 0


@settings(max_examples=50)
@given(seed=st.integers(0, 2**32 - 1), total=st.integers(0, 40), count=st.integers(1, 50), reach=st.floats(0.1, 5.0))
def test_lonely_points_are_those_of_the_definition(seed: int, total: int, count: int, reach: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 10.0, (total, 2)).astype(np.float32)
    scales = np.exp2(rng.uniform(0.0, 2.0, total)).astype(np.float32)
    free = []
    for n in range(total):
        distance = np.linalg.norm(points[:n] - points[n], axis=1)
        alike = np.abs(np.log2(scales[:n] / scales[n])) <= 0.5
        if not np.any(alike & (distance < reach * scales[n])):
            free.append(n)
    assert np.flatnonzero(locally_strongest(points, scales, reach, 2.0**0.5, count)).tolist() == free[:count]
