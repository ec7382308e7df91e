"""Where points are found, on images of which it is known."""

import cv2
import numpy as np
import pytest
from scipy import ndimage

from factorgraph_loc.vision.detector import CLEARANCE, orientations
from factorgraph_loc.vision.features import extractor
from factorgraph_loc.vision.scale_space import STEP, ScaleSpace


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
